"""Identification of a record: noise, turbulence and peaks, with errors and a test. See docs/identification.md.

`identify` uses the observers, and an observer uses parts of it: it is imported when first used.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wfsobs.identification.identification import identify
    from wfsobs.identification.result import Identification

__all__ = ["Identification", "identify"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from wfsobs.identification import identification

        return getattr(identification, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
