"""What messages show of URLs: no names, passwords, signatures and tokens; what a system refuses."""

from __future__ import annotations

import pytest
from rasterio.errors import RasterioIOError

from stereotruth.core.errors import (
    InputError,
    in_words,
    require_packages,
    told_by_system,
    without_secrets,
)

SECRET = "hunter2"
URLS = (
    f"https://me:{SECRET}@host/left.tif",
    f"https://{SECRET}@host/left.tif",
    f"s3://key:{SECRET}@host/left.tif",
    f"https://me:a/{SECRET}@host/left.tif",
    f"https://host/left.tif?X-Amz-Signature={SECRET}&x=1",
    f"https://host/left.tif#{SECRET}",
    f"https:/me:{SECRET}@host/left.tif",  # as pathlib writes it
)
PLAIN = (
    "s3://bucket/a/left.tif: no such file there",
    "https://host:8443/a%20b/left.tif",
    "write C:/x, a@b.org, sigma=0.3, key=4, seed=1 (see docs/how-to.md#parts)",
    "line 3: 'x' ... ? # @",
)


def test_secrets_of_urls_are_not_shown():
    for url in URLS:
        shown = str(InputError(f"no {url} here", file=url, remedy=f"see '{url}'"))
        assert SECRET not in shown and shown.count("host") == 3
    error = InputError("x", file=f"https://host/a?token=b {SECRET}", remedy="y")  # with a blank
    assert SECRET not in str(error) and SECRET not in error.file
    for key in ("X-Amz-Signature", "x-goog-credential", "access_token", "Password"):
        assert without_secrets(f"GET /a?{key}={SECRET}&b=1") == f"GET /a?{key}=…&b=1"
    assert [without_secrets(text) for text in PLAIN] == [*PLAIN]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(28, "No space left on device", "a.zarr"), "a.zarr: no space left on the disk"),
        (OSError(28, "No space left on device"), "no space left on the disk"),
        (FileNotFoundError(2, "No such file or directory", "left.zarr"), "left.zarr: no such file"),
        (FileNotFoundError("left.zarr"), "left.zarr: no such file: it was there"),
        (PermissionError(13, "Permission denied", "a.laz"), "a.laz: no permission"),
        (RasterioIOError("Attempt to create a.tif failed: No space left on device"), "no space"),
        (ExceptionGroup("of threads", [ValueError(), PermissionError(13, "x", "b")]), "b: no perm"),
    ],
)
def test_what_the_system_refuses_is_one_sentence(error, words):
    behind = RuntimeError("in a thread")
    behind.__cause__ = error
    for given in (error, behind):
        told = str(told_by_system(given))
        assert words in told and "Remedy: " in told and "\n" not in told


def test_other_errors_are_defects():
    for error in (ValueError("x"), OSError(5, "Input/output error", "a"), None):
        assert told_by_system(error) is None


def test_a_function_tells_in_words():
    @in_words()
    def read():
        raise PermissionError(13, "Permission denied", "scenes.tsv")

    with pytest.raises(InputError, match=r"scenes\.tsv"):
        read()


def test_a_missing_package_is_named_with_its_extra():
    require_packages("dataset: parquet", ["numpy"], "catalog")
    with pytest.raises(InputError) as refused:
        require_packages("dataset: parquet", ["numpy", "no_such_package"], "catalog")
    assert "no_such_package" in refused.value.problem and "catalog" in refused.value.remedy
