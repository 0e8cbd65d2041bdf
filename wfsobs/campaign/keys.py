"""Keys of results: a digest of all that a result depends on."""

from __future__ import annotations

import hashlib
import json
import sys
from functools import cache

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.rows import NOT_OBSERVERS
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.version import __version__

PHYSICS_VERSION = 6
"""Number of the simulation and its numerics: rises with every change that moves results (tests/campaign/test_physics.py)."""


def scenario_digest(scenario: Scenario) -> str:
    """Return a digest of the settings but for the seed, and of the version of the physics."""
    settings = scenario.to_dict()
    settings["run"] = {k: v for k, v in settings["run"].items() if k != "seed"}
    return hashlib.sha256(json.dumps([PHYSICS_VERSION, settings], sort_keys=True).encode()).hexdigest()


def row_key(digest: str, seed: int, name: str) -> str:
    """Return the key of the rows of one observer, controller or bound, on one record.

    Parameters
    ----------
    digest : str
        That of the scenario.
    seed : int
        Seed of the record.
    name : str
        Id of the observer or controller.

    Returns
    -------
    str
        SHA-256, in hexadecimal.
    """
    return hashlib.sha256(f"{digest} {seed} {name} {package_version(name)}".encode()).hexdigest()


@cache
def package_version(name: str) -> str:
    """Return the package of an observer or a controller and its version; that of wfsobs for bounds.

    >>> package_version("kf-lgs").split()[0]
    'wfsobs'
    """
    if name in NOT_OBSERVERS:
        return f"wfsobs {__version__}"
    entry = OBSERVERS.get(name)
    function = entry.run if entry is not None else CONTROLLERS[name].law or CONTROLLERS[name].step_law
    home = getattr(function, "__module__", "wfsobs").partition(".")[0]
    package = sys.modules.get(home)
    return f"{home} {getattr(package, '__version__', None) or _distribution_version(home)}"


def _distribution_version(home: str) -> str:
    """Return the version of the installed distribution that has this module; "0" for a script."""
    from importlib.metadata import packages_distributions, version

    names = packages_distributions().get(home, [])
    return version(names[0]) if names else "0"
