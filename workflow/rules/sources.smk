"""What products follow from: Snakemake makes again what has other params (profiles/default).

Beside its settings each rule has ``code``, a digest of the modules that run, and ``sources``, digests
of its script and of all that its inputs follow from. Of users' files that is their content, of
products the params and sources of the rule that makes them. So what is behind an edit is due until it is
made, whatever jobs failed or were killed in between. Times of users' files count for nothing.
"""

from functools import cache

from stereotruth.core.products.making import Checksums
from stereotruth.core.products.provenance import digest, script_digest

CHECKSUMS = Checksums(Path(".snakemake", "stereotruth", "checksums"))
BUCKET = workflow.storage_settings.default_storage_prefix or ""
# how rules name their products: below this folder, where they go to object storage
PLACE = "".join(
    f"{part}/"
    for part in (workflow.storage_settings.local_storage_prefix, *BUCKET.split("://"))
    if BUCKET
)


class Wildcards(dict):
    """Wildcards by name, as input functions and params take them."""

    __getattr__ = dict.__getitem__


@cache
def checksum_of(path):
    """Checksum of a user's file or folder, as it is when the run is planned; empty for none."""
    try:
        with in_words():
            return CHECKSUMS.of(path) if Path(path).exists() else ""
    except InputError as error:
        raise Refused(str(error))


@cache
def made_by(path):
    """Name and wildcards of the rule of this workflow that makes a file; None if users give it."""
    for maker in workflow.rules:
        for output in maker.output:
            if found := output.match(path if path.startswith(PLACE) else PLACE + path):
                return maker.name, Wildcards(found.groupdict())
    return None


def given(path):
    """A file that users give: it lies here, wherever products go, and its content counts."""
    path = str(path)
    if made_by(path):
        return path
    if workflow.is_main_process:
        checksum_of(path)  # as it is before the first job begins
    return ancient(local(path))


@cache
def origin(path):
    """Digest of what a file follows from."""
    if maker := made_by(path):
        name, wildcards = maker
        params = dict(workflow.get_rule(name).params.items())
        if "sources" not in params:  # of another workflow, which has this one as a module
            return path
        values = {k: of(wildcards) if callable(of) else of for k, of in params.items()}
        return digest({"wildcards": wildcards, "params": values})
    here = Path.cwd()
    name = Path(path).relative_to(here) if Path(path).is_relative_to(here) else path
    return digest({str(name): checksum_of(path)})


def upstream(name, script=None):
    """Params function: digests of a rule's script, and of what its inputs follow from, by names.

    ``script``: its name, if it is not the rule's. The time of its file counts for nothing.
    """
    content = script_digest(workflow.source_path(f"../scripts/{script or name}.py"))

    def sources(wildcards):
        if not workflow.is_main_process:  # Snakemake keeps the params of the process that plans
            return {}
        found = {"script": content}
        for key, items in workflow.get_rule(name).input.items():
            items = [items] if isinstance(items, str) or callable(items) else items
            files = []
            for item in items:
                of = item(wildcards) if callable(item) else str(item.apply_wildcards(wildcards))
                files += [of] if isinstance(of, (str, Path)) else of
            if key != "strips":  # how many jobs make a grid is not told by its pixels
                found[key] = digest({"files": [origin(str(file)) for file in files]})
        return {key: found[key][:12] for key in sorted(found)}

    return sources
