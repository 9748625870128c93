"""One run at a time, and its last lines."""

import re
import sys

from stereotruth.products.locks import FileLock
from stereotruth.products.records import all_records
from stereotruth.products.reruns import keep_metadata, save_metadata, settle_times
from stereotruth.products.runs import Run, begin_run, end_older_jobs

LOCKS = []  # held until this process ends


def refuse_second_run():
    """End this run if another one works in this directory.

    Snakemake's own lock stays when it is killed; this one does not (profiles/default turns the
    other off).
    """
    lock = FileLock(".snakemake/run.lock")
    if not lock.take(Path.cwd(), wait=False):
        raise WorkflowError(
            f"{Path.cwd()}: another run is at work here ({lock.holder}). "
            "Remedy: wait until it ends, or stop it"
        )
    LOCKS.append(lock)


if not workflow.is_main_process:  # the Snakemake inside a job of the cluster, maybe a late one
    try:
        Run().refuse_older()
    except InputError as error:
        raise WorkflowError(str(error))
else:
    keep_metadata(begin=False)
    settle_times()
    if STORAGE.default_storage_provider:
        MIRROR = record_mirror()


onstart:
    refuse_second_run()
    keep_metadata(begin=True)
    if MIRROR:
        keep_mirrored(MIRROR)
    end_older_jobs()
    begin_run()


def complaints(snakemake_logs):
    """The errors that the failed jobs of a run have logged, one line each."""
    text = "".join(Path(file).read_text("utf-8", "replace") for file in snakemake_logs)
    logs = re.findall(r"^\s+log: (\S+) \(check log", text, flags=re.MULTILINE)
    found = []
    for file in filter(Path.is_file, map(Path, dict.fromkeys(logs))):
        found += re.findall(r"ERROR (.*?: error: .*)", file.read_text("utf-8", "replace"))
    return "\n".join(found)


def made():
    """What the last lines of a run say: what it has made, its figures, and where to look."""
    from stereotruth.last_lines import last_lines  # takes a second, and no plan needs it

    products = [
        product_name(path)
        for job in all_records()
        if job["run"] == Run().name
        for path in job["outputs"]
    ]
    left_out = [
        said for name, said in LEFT_OUT.items() if f"benchmark/{name}/index.html" in products
    ]
    index = list_pages()
    return "\n".join(
        ["", *last_lines(products), *left_out, *([f"All pages: {index}"] if index else [])]
    )


def list_pages():
    """Write the index of all pages, of this run and of earlier ones; its path, if there are any."""
    from stereotruth.report.index_page import write_index

    return write_index()


def say(text):
    """Print, with ? for what a terminal without UTF-8 (LC_ALL=C) cannot show."""
    encoding = sys.stdout.encoding or "ascii"
    print(text.encode(encoding, "replace").decode(encoding))


onsuccess:
    save_metadata()
    keep_states()
    tidy_copies()
    say(made())


onerror:
    save_metadata()
    keep_states()
    list_pages()
    say(complaints(log))
