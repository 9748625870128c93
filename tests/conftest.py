"""Settings of all tests."""

import os
from pathlib import PurePosixPath

import pytest

pytest.register_assert_rewrite("tests.synthetic")

# One thread for linear algebra: two test processes would fight for two cores (measured: 84 s
# against 32 s for the same tests).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Test files of the workflow whose fixtures build on one city, made once for all of them.
OF_ONE_CITY = {"audit", "benchmark", "disturbed", "end_to_end", "predict", "report", "restart"}


def shares_the_city(file: PurePosixPath) -> bool:
    """Whether a test file is one of OF_ONE_CITY."""
    return file.parent.name == "workflow" and file.stem.removeprefix("test_") in OF_ONE_CITY


def pytest_collection_modifyitems(items):
    """Whole runs first, so that no process is left with them when the others have ended."""

    def place(item: pytest.Item) -> int:
        file = PurePosixPath(item.nodeid.partition("::")[0])
        return 0 if shares_the_city(file) else 1 if file.parent.name == "workflow" else 2

    items.sort(key=place)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each file's tests by one process, and those of OF_ONE_CITY too: fixtures are made once.

    The marks of pytest-xdist 3.8 (``--dist loadgroup``) do nothing with pytest 9: both processes
    made every fixture.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFixtures(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = PurePosixPath(nodeid.partition("::")[0])
            return "one city" if shares_the_city(file) else str(file)

    config.option.loadscopereorder = False  # by the number of tests
    return ByFixtures(config, log)
