"""What enters the arena: registered observers and controllers, challengers, objects of a module, folders of estimates."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.registry import ID
from wfsobs.settings.values import SettingError, error_line
from wfsobs_arena.challengers import CHALLENGERS
from wfsobs_arena.identity import code_version
from wfsobs_arena.tracks import Track

REGISTERED, CHALLENGER, MODULE, FOLDER = "registered", "challenger", "module", "folder"


@dataclass(frozen=True)
class ArenaEntry:
    """An entry.

    Attributes
    ----------
    id, label : str
        For files, and for people.
    kind : str
        "registered", "challenger", "module" or "folder".
    place : str
        Id, MODULE:NAME, or path of the folder.
    version : str
        Of its code or files: results of another version are not its own.
    """

    id: str
    label: str
    kind: str
    place: str
    version: str


def find_entries(names: Sequence[str] = ()) -> list[ArenaEntry]:
    """Return entries.

    Parameters
    ----------
    names : sequence of str
        Ids of observers, controllers and challengers, MODULE:NAME of an object of a module, or folders; by default all that are
        registered and all challengers.

    Returns
    -------
    list of ArenaEntry
        In the order of the names.

    Raises
    ------
    SettingError
        There is no such entry, or two have one id.
    """
    chosen = names or [*OBSERVERS, *CHALLENGERS, *CONTROLLERS]
    entries = [_find(name) for name in dict.fromkeys(chosen)]
    ids = [entry.id for entry in entries]
    for id_ in ids:
        if ids.count(id_) > 1:
            raise SettingError(f"--entry: two entries have the id {id_!r}")
    return entries


def _find(name: str) -> ArenaEntry:
    if name in OBSERVERS or name in CONTROLLERS:
        return _of_object(OBSERVERS.get(name) or CONTROLLERS[name], REGISTERED, name)
    if name in CHALLENGERS:
        return _of_object(CHALLENGERS[name].algorithm, CHALLENGER, name)
    if Path(name).is_dir():
        files = sorted(Path(name).glob("*.npz"))
        digest = hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files))
        return ArenaEntry(Path(name).resolve().name, Path(name).resolve().name, FOLDER, name, digest.hexdigest()[:16])
    if ":" in name:
        return _of_object(_from_module(name), MODULE, name)
    known = ", ".join([*OBSERVERS, *CHALLENGERS, *CONTROLLERS])
    raise SettingError(f"--entry {name}: takes {known}, MODULE:NAME or a folder of estimates")


def _of_object(algorithm: Any, kind: str, place: str) -> ArenaEntry:
    return ArenaEntry(algorithm.id, algorithm.label, kind, place, code_version(algorithm))


def load_object(entry: ArenaEntry) -> Any:
    """Return the observer or controller of an entry. Raises SettingError."""
    if entry.kind == CHALLENGER:
        return CHALLENGERS[entry.place].algorithm
    if entry.kind == MODULE:
        return _from_module(entry.place)
    return OBSERVERS.get(entry.place) or CONTROLLERS[entry.place]


def _from_module(name: str) -> Any:
    if (here := os.getcwd()) not in sys.path:  # as `python -m` has it; processes that are started take over the list
        sys.path.insert(0, here)
    module, _, attribute = name.partition(":")
    try:
        algorithm = getattr(import_module(module), attribute)
    except Exception as error:
        raise SettingError(f"--entry {name}: cannot be imported: {error_line(error)}") from None
    kinds = (OBSERVERS.kind, CONTROLLERS.kind)
    if not isinstance(algorithm, kinds):
        raise SettingError(f"--entry {name}: takes an Observer or a Controller, not a {type(algorithm).__name__}")
    if not ID.fullmatch(str(algorithm.id)):  # it names a folder
        raise SettingError(f"--entry {name}: the id {algorithm.id!r} takes lower-case letters, digits and hyphens between them")
    return algorithm


def admits(track: Track, entry: ArenaEntry) -> bool:
    """Return whether an entry can take part in a track; a folder can wherever estimates are asked."""
    if entry.kind == FOLDER:
        return not track.is_loop
    if entry.kind == CHALLENGER and track.id not in CHALLENGERS[entry.place].tracks:
        return False
    algorithm = load_object(entry)
    return track.admits(algorithm) if isinstance(algorithm, Observer) else track.is_loop
