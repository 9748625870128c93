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


def bucket_records():
    """The records of the products in the bucket, brought here; what differs there is marked."""
    from stereotruth.products.bucket_records import BucketRecords

    try:
        records = BucketRecords(STORAGE.default_storage_prefix, copies())
        records.pull()
        records.mark_changed()
    except InputError as error:
        raise Refused(str(error))
    return records


def keep_in_bucket(records):
    """Have each job's mark and record in the bucket before and after its products."""
    persistence = workflow.persistence
    started, finished = persistence.started, persistence.finished

    def started_there(*job, **how):
        started(*job, **how)
        records.push()

    async def finished_there(*job, **how):
        await finished(*job, **how)
        records.push()

    persistence.started, persistence.finished = started_there, finished_there


def tidy_copies():
    """Remove what jobs have kept here to be carried on after a kill: all is in the bucket."""
    if STORAGE.default_storage_provider and not STORAGE.keep_storage_local:
        shutil.rmtree(STORAGE.local_storage_prefix, ignore_errors=True)


BUCKET = None
if STORAGE.default_storage_provider and SETTINGS.strips != 1:
    raise Refused(
        "strips: jobs that write parts of one store need a file system that all see, and products "
        f"go to {STORAGE.default_storage_prefix}. Remedy: take strips out of the configuration"
    )
