"""Records in a bucket (fsspec's in memory): two checkouts that see the same."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from stereotruth.products.record_mirror import RecordMirror

COPIES = Path(".snakemake/storage/memory")


def key(product: str) -> str:
    """As Snakemake names its records, folders where a name grows too long."""
    name = base64.urlsafe_b64encode(product.encode()).decode()
    return f"@{name[:254]}/{name[254:]}" if len(name) > 254 else name


@pytest.fixture
def prefix(tmp_path) -> str:
    return f"memory://bucket/{tmp_path.name}"


@pytest.fixture
def at(tmp_path, monkeypatch, prefix):
    """Goes to a checkout; returns the mirror that a run there begins with."""

    def go(name: str) -> RecordMirror:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        monkeypatch.chdir(folder)
        mirror = RecordMirror(prefix, COPIES)
        mirror.pull()
        return mirror

    return go


def write(file: str, text: str) -> Path:
    path = Path(file)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_marks_and_records_reach_another_checkout_and_go_again(at, prefix):
    long = f"{prefix}/tiles/{'x' * 300}"
    first = at("first")
    mark = write(f".snakemake/incomplete/{key(prefix + '/tiles/A')}", "{}")
    write(f".snakemake/incomplete/{key(long)}", '{"external_jobid": "1"}')
    made = write(f"results/.records/made/{COPIES}/bucket/tiles/A.json", '{"made": ""}')
    first.push()

    at("second")
    assert mark.read_text() == "{}"
    assert Path(f".snakemake/incomplete/{key(long)}").read_text() == '{"external_jobid": "1"}'
    assert made.read_text() == '{"made": ""}'

    at("first")
    mark.unlink()
    made.write_text('{"made": "1"}')
    first.push()
    at("second")
    assert not mark.exists()
    assert made.read_text() == '{"made": "1"}'


def test_records_of_products_here_and_of_other_prefixes_stay(at, prefix):
    mirror = at("first")
    kept = [
        write(f".snakemake/incomplete/{key('tiles/A')}", "here"),
        write(f".snakemake/incomplete/{key(prefix + 'er/tiles/A')}", "of another prefix"),
        write("results/.records/made/tiles/A.json", "here"),
    ]
    mirror.push()
    mirror = at("first")
    assert all(file.exists() for file in kept)
    at("second")
    assert not any(file.exists() for file in kept)
