"""One run at a time, and its last lines."""

import shutil
import sys

from stereotruth.core.job import failures
from stereotruth.core.products.making import FileLock, begin_notes, noted

LOCKS = []  # held until this process ends

if BUCKET and SETTINGS.strips != 1:
    raise Refused(
        "strips: jobs that write parts of one store need a file system that all see, and products "
        f"go to {BUCKET}. Remedy: take strips out of the configuration"
    )


onstart:
    # Snakemake's own lock stays when it is killed; this one does not (profiles/default turns the
    # other off).
    lock = FileLock(".snakemake/run.lock")
    if not lock.take(Path.cwd(), wait=False):
        raise Refused(
            f"{Path.cwd()}: another run is at work here ({lock.holder}). "
            "Remedy: wait until it ends, or stop it"
        )
    LOCKS.append(lock)
    begin_notes()


def made():
    """What the last lines of a run say: what it has made, its figures, and where to look."""
    from stereotruth.project.last_lines import last_lines  # takes a second; no plan needs it

    products = [f"{BUCKET}/{path.removeprefix(PLACE)}" if BUCKET else path for path in noted()]
    left_out = [
        said for name, said in LEFT_OUT.items() if f"benchmark/{name}/index.html" in products
    ]
    index = list_pages()
    return "\n".join(
        ["", *last_lines(products), *left_out, *([f"All pages: {index}"] if index else [])]
    )


def list_pages():
    """Write the index of all pages, of this run and of earlier ones; its path, if there are any."""
    from stereotruth.evaluate.report.index_page import write_index

    try:
        return write_index()
    except (InputError, OSError) as error:
        return f"none, {error}"


def say(text):
    """Print, with ? for what a terminal without UTF-8 (LC_ALL=C) cannot show."""
    encoding = sys.stdout.encoding or "ascii"
    print(text.encode(encoding, "replace").decode(encoding))


onsuccess:
    if (
        BUCKET and not workflow.storage_settings.keep_storage_local
    ):  # what killed jobs have left
        shutil.rmtree(workflow.storage_settings.local_storage_prefix, ignore_errors=True)
    say(made())


onerror:
    list_pages()
    say("\n".join(failures()))
