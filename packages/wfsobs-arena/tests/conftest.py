"""Where modules are is looked up once: it stays the same while these tests run."""

from collections.abc import Iterator
from functools import cache

import pytest
from wfsobs_arena import identity


@pytest.fixture(autouse=True, scope="session")
def known_modules() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identity, "_source_of", cache(identity._source_of))
        yield
