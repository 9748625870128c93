"""Products in object storage (profiles/s3): their records, and what is left here."""

import shutil

STORAGE = workflow.storage_settings


def copies():
    """The folder in which jobs have the products of the bucket while they run."""
    return STORAGE.local_storage_prefix / STORAGE.default_storage_provider


def product_name(path):
    """What users call a product that a job has written: its path, or its URL in the bucket."""
    if STORAGE.default_storage_provider and Path(path).is_relative_to(copies()):
        return f"{STORAGE.default_storage_provider}://{Path(path).relative_to(copies())}"
    return path


def record_mirror():
    """The records of the products in the bucket, brought here; what differs there is marked."""
    from stereotruth.products.record_mirror import RecordMirror
    from stereotruth.products.stored_states import StoredStates

    mirror = RecordMirror(STORAGE.default_storage_prefix, copies())
    mirror.pull()
    StoredStates(STORAGE.default_storage_prefix, copies()).mark_changed()
    return mirror


def keep_states():
    """Keep what the bucket holds of the products that this run has made."""
    from stereotruth.products.stored_states import StoredStates

    if STORAGE.default_storage_provider:
        StoredStates(STORAGE.default_storage_prefix, copies()).keep(Run().name)


def keep_mirrored(mirror):
    """Have each job's mark and records in the bucket before and after its products."""
    persistence = workflow.persistence
    started, finished = persistence.started, persistence.finished

    def started_there(*job, **how):
        started(*job, **how)
        mirror.push()

    async def finished_there(*job, **how):
        await finished(*job, **how)
        mirror.push()

    persistence.started, persistence.finished = started_there, finished_there


def tidy_copies():
    """Remove what jobs have kept here to be carried on after a kill: all is in the bucket."""
    if STORAGE.default_storage_provider and not STORAGE.keep_storage_local:
        shutil.rmtree(STORAGE.local_storage_prefix, ignore_errors=True)


MIRROR = None
if STORAGE.default_storage_provider and SETTINGS.strips != 1:
    raise WorkflowError(
        "strips: jobs that write parts of one store need a file system that all see, and products "
        f"go to {STORAGE.default_storage_prefix}. Remedy: take strips out of the configuration"
    )
