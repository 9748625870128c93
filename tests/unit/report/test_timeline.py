"""The timeline of a run, from logs and the figures that Snakemake writes."""

from __future__ import annotations

from pathlib import Path

from stereotruth.report.timeline import last_run, read_jobs, timeline

HEAD = "s\th:m:s\tmax_rss\tcpu_time\n"


def write_job(root: Path, name: str, ended: str, seconds: float, memory: str) -> None:
    file = root / "logs" / f"{name}.tsv"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"{HEAD}{seconds}\t0:00:00\t{memory}\t1\n")
    text = f"2026-01-02 00:00:00,000 INFO x: begins\n2026-01-02 {ended},500 INFO x: ends\n  trace\n"
    file.with_suffix(".log").write_text(text)


def test_jobs_stand_where_they_ran_and_the_last_run_alone(tmp_path):
    write_job(tmp_path, "ingest/A/old", "01:00:00", 50, "70")
    write_job(tmp_path, "ingest/A/one", "03:00:40", 40, "100.0")
    write_job(tmp_path, "project/A", "03:01:00", 30, "-")
    write_job(tmp_path, "project/B", "03:01:40", 60, "250")
    (tmp_path / "logs/project/none.tsv").write_text(HEAD)
    run = last_run(read_jobs(tmp_path))
    assert [(job.rule, job.of, job.memory_mb) for job in run] == [
        ("ingest", "A/one", 100),
        ("project", "A", 0),
        ("project", "B", 250),
    ]
    drawn = timeline(run)
    assert drawn is not None
    assert [rule for _, rule in drawn.rows] == ["ingest", "project"]
    by_text = {bar.text.partition(":")[0]: bar for bar in drawn.bars}
    assert (by_text["ingest A/one"].x, by_text["ingest A/one"].width) == (0.0, 360.0)
    assert (by_text["project A"].x, by_text["project A"].width) == (270.0, 270.0)
    assert by_text["project B"].x + by_text["project B"].width == 900.0
    assert drawn.most_memory == "250 MB"  # B begins as the first ends
    assert drawn.caption.startswith("3 jobs from 2026-01-02 03:00, 100.0 s")
    assert [[c.text for c in row] for row in drawn.table.groups[0][1]] == [
        ["ingest", "1", "40", "40", "100"],
        ["project", "2", "90", "60", "250"],
    ]


def test_a_folder_without_logs_has_no_timeline(tmp_path):
    assert timeline(last_run(read_jobs(tmp_path))) is None
