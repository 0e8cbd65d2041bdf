"""What is installed, and where modules are, is looked up once: it stays the same while these tests run."""

from collections.abc import Iterator
from functools import cache

import pytest
from wfsobs_arena import identity


@pytest.fixture(autouse=True, scope="session")
def known_modules() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("packages_distributions", "_source_of"):
            patch.setattr(identity, name, cache(getattr(identity, name)))
        yield
