"""One run at a time, and its last lines."""

import sys

from stereotruth.products.locks import FileLock
from stereotruth.products.records import all_records
from stereotruth.products.runs import Run, begin_run

LOCKS = []  # held until this process ends


def refuse_second_run():
    """End this run if another one works in this directory.

    Snakemake's own lock stays when it is killed; this one does not (profiles/default turns the
    other off).
    """
    lock = FileLock(".snakemake/run.lock")
    if not lock.take(Path.cwd(), wait=False):
        raise Refused(
            f"{Path.cwd()}: another run is at work here ({lock.holder}). "
            "Remedy: wait until it ends, or stop it"
        )
    LOCKS.append(lock)


if not workflow.is_main_process:  # the Snakemake inside a job of the cluster, maybe a late one
    try:
        Run().refuse_older()
    except InputError as error:
        raise Refused(str(error))
elif STORAGE.default_storage_provider:
    BUCKET = bucket_records()


onstart:
    refuse_second_run()
    if BUCKET:
        keep_in_bucket(BUCKET)
    begin_run()


def made():
    """What the last lines of a run say: what it has made, its figures, and where to look."""
    from stereotruth.last_lines import last_lines  # takes a second, and no plan needs it

    products = [
        product_name(path) for job in all_records() if job.run == Run().name for path in job.outputs
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

    try:
        return write_index()
    except (InputError, OSError) as error:
        return f"none, {error}"


def say(text):
    """Print, with ? for what a terminal without UTF-8 (LC_ALL=C) cannot show."""
    encoding = sys.stdout.encoding or "ascii"
    print(text.encode(encoding, "replace").decode(encoding))


onsuccess:
    if BUCKET:
        BUCKET.keep_states(Run().name)
    tidy_copies()
    say(made())


onerror:
    if BUCKET:
        BUCKET.keep_states(Run().name)
    list_pages()
    from stereotruth.last_lines import complaints

    say(complaints(log))
