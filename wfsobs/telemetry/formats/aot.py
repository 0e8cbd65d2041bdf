"""Records as AOT, the Adaptive Optics Telemetry format, through aotpy (the extra wfsobs[aot]).

T. Gomes et al., J. Astron. Telesc. Instrum. Syst. 10, 2024. The first control loop of a file is read. y_lgs are its sensor's
measurements, turned into modes by measurements_to_modes where the file has it, otherwise tip and tilt of one subaperture;
u are its modal coefficients, or its commands turned by commands_to_modes. y_ngs are the measurements of a second sensor, that
of a natural guide star. Measurements and commands are written: AOT has no place for a truth, an open-loop measurement or a
training record.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from typing import IO, Any

import numpy as np

from wfsobs.record import DELAY, RecordError
from wfsobs.telemetry.formats.contents import (
    MEAN_SLOPES,
    NUMBERS,
    FileColumns,
    TooLargeError,
    import_library,
    mean_slopes,
    numbers_and_texts,
    read_at_most,
)
from wfsobs.telemetry.formats.fits import open_fits, tables_and_images
from wfsobs.typing import Array
from wfsobs.units import parse_unit

PREFIX = "WFSOBS-"
"""Prefix of the names of images and metadata written here."""
KEYWORD = "AOT-VERS"
"""In the header of an AOT file."""


_aotpy = partial(import_library, "aotpy", "aot", "AOT files")


def read(file: IO[bytes], most: int) -> FileColumns:
    """Read an AOT file. Raises RecordError, TooLargeError.

    Images outside the file are refused: nothing but the file is opened.
    """
    aotpy = _aotpy()
    with open_fits(file, most) as hdus:  # checks the sizes
        for hdu in hdus[1:]:
            _check_lists(hdu, most)
    from aotpy.io.fits import AOTFITSErrorLevel

    critical = AOTFITSErrorLevel.CRITICAL
    try:
        reader = aotpy.AOTFITSReader(
            io.BytesIO(read_at_most(file, most)), externals="disallow", exception_level=critical, log_level=critical
        )
        return _contents(reader.get_system(), aotpy)
    except RecordError:
        raise
    except Exception as error:  # of many kinds, by what a file lacks
        raise RecordError(f"not an AOT file that aotpy can read: {' '.join(str(error).split())[:200]}") from None


TRANSLATED = ("ciao", "eris", "galacsi", "gpao", "naomi", "papyrus")
"""Observatories' dumps that aotpy translates."""


def translate(name: str, arguments: Sequence[str]) -> IO[bytes]:
    """Return the dump of one of TRANSLATED as an AOT file, without pixels; its translator opens the files. Raises RecordError.

    arguments : those of aotpy's translator: folders or a file, and the number of a telescope
    """
    aotpy = _aotpy()
    from aotpy import translators

    try:
        with warnings.catch_warnings(action="ignore"):
            translator = getattr(translators, f"{name.upper()}Translator")
            system = translator.translate(*(int(text) if text.isdecimal() else text for text in arguments))
            for sensor in system.wavefront_sensors:
                sensor.detector = sensor.subaperture_intensities = None
            aotpy.AOTFITSWriter(system).get_hdulist().writeto(file := io.BytesIO())
    except Exception as error:  # of many kinds, by what a folder lacks
        raise RecordError(f"no {name.upper()} dump that aotpy translates: {' '.join(str(error).split())[:200]}") from None
    file.seek(0)
    return file


def read_fits(file: IO[bytes], most: int) -> FileColumns:
    """Read the tables and images of a FITS file, or an AOT file, which says so inside. Raises RecordError, TooLargeError."""
    with open_fits(file, most) as hdus:
        if KEYWORD not in hdus[0].header:
            return tables_and_images(hdus, most)
    return read(file, most)


def _check_lists(hdu: Any, most: int) -> None:
    """Check the memory that the lists of a table would take: many rows may point to one heap."""
    if getattr(hdu, "columns", None) is None or hdu.data is None:
        return
    for column in hdu.columns:
        if ("P" in column.format or "Q" in column.format) and len(hdu.data):
            raw = np.asarray(hdu.data.view(np.ndarray)[column.name])
            if raw.reshape(len(hdu.data), -1)[:, 0].astype(float).sum() * 8 > most:
                raise TooLargeError(most)


def _rows(image: Any) -> Any:
    """Return an image (m, ...) as a matrix, (m, n), None where there is none."""
    return None if image is None else np.asarray(image.data, dtype=np.float64).reshape(len(image.data), -1)


def _matrices(loop: Any) -> dict[str, Array]:
    """Return the matrices of a loop by AOT's names: from slopes to modes, through commands where these are modes or have some."""
    control, modes = _rows(loop.control_matrix), _rows(loop.commands_to_modes)
    found = {
        "measurements_to_modes": _rows(loop.measurements_to_modes),
        "control_matrix": control if modes is None or control is None else modes @ control,
        "modes_to_commands": _rows(loop.modes_to_commands),
    }
    shape = np.shape(loop.input_sensor.measurements.data)
    if getattr(loop.input_sensor, "subaperture_mask", None) is not None and len(shape) == 3 and shape[1] == 2:
        found[MEAN_SLOPES] = mean_slopes(shape[2])
    return {name: matrix for name, matrix in found.items() if matrix is not None}


def _contents(system: Any, aotpy: Any) -> FileColumns:
    loops = (loop for loop in system.loops if isinstance(loop, aotpy.ControlLoop))
    loop = next((loop for loop in loops if getattr(loop.input_sensor, "measurements", None) is not None), None)
    if loop is None:
        raise RecordError("has no control loop with measurements")
    sensor, contents = loop.input_sensor, FileColumns(matrices=_matrices(loop))
    measured = sensor.measurements
    _take(contents, "y_lgs", measured, _rows(loop.measurements_to_modes))
    if loop.modal_coefficients is not None:
        _take(contents, "u", loop.modal_coefficients, None)
    elif loop.commands is not None:
        _take(contents, "u", loop.commands, _rows(loop.commands_to_modes))
    natural = (s for s in system.wavefront_sensors if s is not sensor and isinstance(s.source, aotpy.NaturalGuideStar))
    frames = next((s.measurements for s in natural if s.measurements is not None), None)
    if frames is not None:
        _take(contents, "y_ngs", frames, None)
    for name, clock in (("time", measured.time or loop.time), ("time_ngs", frames and frames.time)):
        if clock is not None and clock.timestamps:
            contents.arrays[name] = np.asarray(clock.timestamps, dtype=np.float64)
    if loop.framerate:
        contents.arrays["dt"] = np.array(1.0 / loop.framerate)
    if loop.delay is not None and np.isfinite(loop.delay):
        # both count from the middle of an exposure to the middle of the step in which its command acts
        contents.arrays["delay"] = np.array(max(1.0, float(loop.delay)))
    for entry in system.metadata:
        if entry.key.upper().startswith(PREFIX):
            name = entry.key[len(PREFIX) :].lower()
            contents.arrays[name] = np.array(float(entry.value) if name in NUMBERS else entry.value)
    return contents


def _take(contents: FileColumns, name: str, image: Any, matrix: Array | None) -> None:
    """Read the rows of an image as modes, through a matrix (m, ...) where there is one."""
    rows = _rows(image)
    contents.arrays[name] = rows = rows if matrix is None else rows @ matrix.T
    are_modes = name != "y_lgs" or rows.shape[1] <= 2 or parse_unit(image.unit or "")  # slopes may be in pixels
    if image.unit and matrix is None and are_modes:
        contents.state_unit(name, image.unit)


def write(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write measurements and commands as one control loop."""
    aotpy = _aotpy()
    plain = numbers_and_texts(arrays, "ascii")
    n_modes = arrays["y_lgs"].shape[1]
    telescope = aotpy.MainTelescope(uid="telescope")

    def image(name: str, shape: tuple[int, ...]) -> Any:
        return aotpy.Image(name=PREFIX + name, data=np.asarray(arrays[name], dtype=np.float64).reshape(shape), unit="um")

    def sensor(uid: str, source: Any, name: str) -> Any:
        # one signal per mode; for tip and tilt that is a sensor of a single subaperture
        measurements = image(name, (-1, 1, n_modes))
        return aotpy.Pyramid(
            uid=uid, source=source, dimensions=1, n_valid_subapertures=n_modes, n_sides=4, measurements=measurements
        )

    laser = aotpy.SodiumLaserGuideStar(uid="LGS")
    lgs = sensor("LGS WFS", laser, "y_lgs")
    sources, sensors = [laser], [lgs]
    if "y_ngs" in arrays:
        star = aotpy.NaturalGuideStar(uid="NGS")
        sources.append(star)
        sensors.append(sensor("NGS WFS", star, "y_ngs"))
    mirror = aotpy.DeformableMirror(uid="mirror", telescope=telescope, n_valid_actuators=n_modes)
    loop = aotpy.ControlLoop(
        uid="loop",
        commanded_corrector=mirror,
        input_sensor=lgs,
        modal_coefficients=image("u", (-1, n_modes)),
        framerate=1.0 / float(plain["dt"]),
        delay=float(plain.get("delay", DELAY)),
    )
    system = aotpy.AOSystem(
        ao_mode="LTAO",
        name="wfsobs",
        main_telescope=telescope,
        sources=sources,
        wavefront_sensors=sensors,
        wavefront_correctors=[mirror],
        loops=[loop],
        config="; ".join(str(plain.get("scenario", "")).splitlines()) or None,
        # as texts: a number in a header has sixteen digits, one less than dt may need
        metadata=[aotpy.Metadatum(PREFIX + key.upper(), str(plain[key])) for key in (*NUMBERS, "origin") if key in plain],
    )
    aotpy.AOTFITSWriter(system).get_hdulist().writeto(file)
