"""From a record to the model behind it: noise, turbulence, peaks, with errors and a test. docs/identification.md has it all.

`identify` uses the observers, and an observer uses parts of it: it is imported once it is asked for.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wfsobs.identification.identification import identify
    from wfsobs.identification.result import Identified

__all__ = ["Identified", "identify"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from wfsobs.identification import identification

        return getattr(identification, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
