"""What messages show of URLs: no names, passwords, signatures and tokens."""

from __future__ import annotations

import pytest

from stereotruth.errors import InputError, without_secrets

SECRET = "hunter2"


@pytest.mark.parametrize(
    "url",
    [
        f"https://me:{SECRET}@host/left.tif",
        f"https://{SECRET}@host/left.tif",
        f"s3://key:{SECRET}@bucket/left.tif",
        f"https://me:a/{SECRET}@host/left.tif",
        f"https://host/left.tif?X-Amz-Signature={SECRET}&x=1",
        f"https://host/left.tif?token={SECRET}",
        f"https://host/left.tif#{SECRET}",
        f"https:/me:{SECRET}@host/left.tif",  # as pathlib writes it
    ],
)
def test_secrets_of_urls_are_not_shown(url):
    shown = str(InputError(f"no {url} here", file=url, remedy=f"see '{url}'"))
    assert SECRET not in shown
    assert shown.count("host" if "host" in url else "bucket") == 3


def test_secrets_of_urls_with_blanks_are_not_shown_as_files():
    error = InputError("x", file=f"https://host/a?token=b {SECRET}", remedy="y")
    assert SECRET not in str(error) and SECRET not in error.file


@pytest.mark.parametrize(
    "key", ["X-Amz-Signature", "x-goog-credential", "access_token", "Password"]
)
def test_secrets_without_their_url_are_not_shown(key):
    assert without_secrets(f"GET /a?{key}={SECRET}&b=1") == f"GET /a?{key}=…&b=1"


@pytest.mark.parametrize(
    "text",
    [
        "s3://bucket/a/left.tif: no such file there",
        "https://host:8443/a%20b/left.tif",
        "write C:/x, a@b.org, sigma=0.3, key=4, seed=1 (see docs/how-to.md#parts)",
        "line 3: 'x' ... ? # @",
    ],
)
def test_other_texts_stay_as_they_are(text):
    assert without_secrets(text) == text
