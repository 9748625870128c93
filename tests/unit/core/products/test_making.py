"""One job at a time makes a product, of inputs that stay as they are."""

from __future__ import annotations

import threading

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import atomic_file
from stereotruth.core.products.making import begin_notes, making, marks_of_inputs, noted


def test_a_later_job_waits_and_has_the_last_word(tmp_path):
    """The first is late, as a job of a killed run may be that was stopped."""
    product, at_work, go_on = tmp_path / "a.txt", threading.Event(), threading.Event()

    def late() -> None:
        with making([], [product]):
            at_work.set()
            go_on.wait(60)
            product.write_text("late")

    def next_one() -> None:
        with making([], [product]):
            product.write_text("next")

    threads = [threading.Thread(target=job) for job in (late, next_one)]
    threads[0].start()
    at_work.wait(60)
    threads[1].start()
    threads[1].join(0.2)
    assert threads[1].is_alive() and not product.exists()
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert product.read_text() == "next"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_an_input_that_is_edited_and_put_back_ends_the_job(tmp_path):
    source, product = tmp_path / "in.csv", tmp_path / "a.txt"
    source.write_text("1,2")
    with pytest.raises(InputError, match=r"in\.csv: changed while it was being used"):  # noqa: SIM117
        with making([source], [product]), atomic_file(product) as scratch:
            assert marks_of_inputs()
            source.write_text("3,4,5")
            source.write_text("1,2")
            scratch.write_text("made of either")
    assert not marks_of_inputs()


def test_what_the_jobs_of_a_run_made_is_noted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with making([], ["before.txt"]):
        pass
    assert noted() == []  # no run has begun
    begin_notes()
    with making([], ["one.txt", "two"]):
        pass
    with pytest.raises(ValueError), making([], ["failed.txt"]):
        raise ValueError
    assert noted() == ["one.txt", "two"]
    begin_notes()
    assert noted() == []
