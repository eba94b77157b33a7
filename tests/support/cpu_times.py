"""Plugin of pytest that names tests which take more CPU time than one that is not slow may."""

import os
from collections.abc import Generator

import pytest

MOST_SECONDS = 5.0
BEGAN = pytest.StashKey[float]()


def read_cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that ended."""
    return sum(os.times()[:4])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Note when a test begins, before its fixtures do."""
    item.stash[BEGAN] = read_cpu_seconds()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Write the time into the last report of a test, which pytest-xdist sends to one process."""
    report = yield
    if report.when == "teardown":
        seconds = read_cpu_seconds() - item.stash[BEGAN]
        report.user_properties.append(("cpu_seconds", seconds))
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the tests above the limit, the longest first; none fails for it."""
    seconds = {
        report.nodeid: dict(report.user_properties)["cpu_seconds"]
        for reports in terminalreporter.stats.values()
        for report in reports
        if getattr(report, "when", None) == "teardown" and "slow" not in report.keywords
    }
    long = sorted((taken, name) for name, taken in seconds.items() if taken > MOST_SECONDS)
    if long:
        terminalreporter.section(f"above {MOST_SECONDS:.0f} CPU seconds, with shared set-up")
        for taken, name in reversed(long):
            terminalreporter.line(f"{taken:6.1f} {name}")
