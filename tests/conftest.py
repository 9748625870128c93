"""Settings of all tests."""

import os
from pathlib import PurePosixPath

import pytest

pytest.register_assert_rewrite("tests.synthetic")

# One thread for linear algebra: two test processes would fight for two cores (measured: 84 s
# against 32 s for the same tests). OpenMP's threads would wait for each other by spinning. A fork
# of a process that has OpenCV's threads waits for them for ever, since it has none of them.
for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(threads, "1")

# Test files that processes begin with: the first makes the city of the workflow's tests and all
# that follows from it, which the others wait for; the next ones need nothing of it.
FIRST = ("test_audit", "test_plans", "test_job_start")
LONGEST = ("labels", "tiles", "align", "lidar")  # rooms, before those that take less


def pytest_collection_modifyitems(items):
    """Whole runs before short tests, so that no process is left with one at the end. Those that
    need the stages after the tiles are slow, and come last of the whole runs: one process makes
    these stages, and no other waits for them."""
    waiting = {_file(item.nodeid) for item in items if "later" in item.fixturenames}

    def place(item: pytest.Item) -> int:
        file = PurePosixPath(_file(item.nodeid))
        if file.parent.name != "workflow":
            return len(FIRST) + 2 + LONGEST.index(room) if (room := _room(file)) in LONGEST else 99
        if file.stem in FIRST:
            return FIRST.index(file.stem)
        return len(FIRST) + (str(file) in waiting)

    items.sort(key=place)
    for item in items:
        if "later" in item.fixturenames:
            item.add_marker(pytest.mark.slow)


def _file(nodeid: str) -> str:
    """The file of a test, by pytest's name of the test."""
    return nodeid.partition("::")[0]


def _room(file: PurePosixPath) -> str:
    """The room whose unit tests a file has; empty if it has none."""
    return file.parts[2] if file.parts[1] == "unit" and len(file.parts) > 3 else ""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each room's tests by one process, in the order above: what they share is made once, and
    kernels are loaded once. Whole runs wait for each other: of these, each file's tests."""
    from xdist.scheduler import LoadScopeScheduling

    class ByRoom(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = PurePosixPath(_file(nodeid))
            return _room(file) or str(file)

    config.option.loadscopereorder = False  # by the number of tests
    return ByRoom(config, log)
