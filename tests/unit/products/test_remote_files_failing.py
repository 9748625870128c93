"""What a server or its client fails with, in one sentence with the remedy."""

from __future__ import annotations

import pytest

from stereotruth.errors import InputError
from stereotruth.products.remote_files import _file_system, answering, stand_in

pytest.importorskip("s3fs")


def bucket_fails(tmp_path, monkeypatch, match, **environment):
    import s3fs

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE", "AWS_ENDPOINT_URL"):
        monkeypatch.delenv(name, raising=False)
    quick = {"AWS_EC2_METADATA_DISABLED": "true", "AWS_MAX_ATTEMPTS": "1"}
    nowhere = {"AWS_CONFIG_FILE": "/none", "AWS_SHARED_CREDENTIALS_FILE": "/none"}
    for name, value in {**quick, **nowhere, **environment}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)
    s3fs.S3FileSystem.clear_instance_cache()
    _file_system.cache_clear()
    with pytest.raises(InputError, match=match):
        stand_in("s3://bucket/x.tif")


KEYS = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}


def test_without_credentials(tmp_path, monkeypatch):
    fails = r"s3://bucket/x.tif: no credentials for it\. Remedy: export AWS_ACCESS_KEY_ID"
    bucket_fails(tmp_path, monkeypatch, fails)


def test_an_end_point_where_nobody_answers(tmp_path, monkeypatch):
    nobody = {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}
    bucket_fails(tmp_path, monkeypatch, "nobody answers there", **KEYS, **nobody)


def test_a_host_that_is_unknown(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"its host is unknown\. Remedy: correct the URL"):
        stand_in("https://no-such-host.invalid/a.tif")


def test_refused_access():
    with pytest.raises(InputError, match="refuses access"), answering("s3://bucket/x"):
        raise PermissionError("Access Denied")
