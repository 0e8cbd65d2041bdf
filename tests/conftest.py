"""One BLAS thread, set before numpy is imported; a folder of records and an installed package that tests share."""

import gc
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(name, "1")

if find_spec("hypothesis"):  # the tests in other programs do without
    from hypothesis import settings

    settings.register_profile("no clock", deadline=None)  # a busy machine is no fault
    settings.load_profile("no clock")

FOLDER = "WFSOBS_TEST_RECORDS"
"""Environment variable: the folder of this session's records, for `tests.records`."""

HERE = Path(__file__).parent


def pytest_configure(config: pytest.Config) -> None:
    """Make the folder of records that tests share; workers find the one of the session."""
    if FOLDER not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="wfsobs-records-")
        os.environ[FOLDER] = folder.name
        config.add_cleanup(folder.cleanup)
        config.add_cleanup(lambda: os.environ.pop(FOLDER))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import files that are slow as a whole where what is slow is left out."""
    if config.option.markexpr != "not slow" or not collection_path.match("test_*.py"):
        return None
    return "\npytestmark = pytest.mark.slow\n" in collection_path.read_text(encoding="utf-8") or None


def pytest_collection_finish() -> None:
    """Have the collector, when it looks through all, pass over the half million objects of tests and imports."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package of examples/ installed, to be put on the path of a process."""
    folder = tmp_path_factory.mktemp("example")
    shutil.copytree(HERE.parent / "examples" / "wfsobs-example", folder / "source")
    install = ("pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check")
    subprocess.run([sys.executable, "-m", *install, "--target", "installed", "./source"], cwd=folder, check=True)
    return folder / "installed"
