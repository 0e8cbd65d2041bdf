"""Every linear controller over an uncertain plant: what it leaves at the plant that it is designed for, on average and at worst.

The errors of the plant are independent and uniform around those of the scenario. They are taken at the points of Sobol's sequence
and at all corners; stability and residual are by theory (`control.mismatch`), on fewer frequencies than for a single loop. Other
controllers are simulated, at fewer points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil, inf, log2
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy

from wfsobs.closed_loop.design import design, loop_spectra, select_controllers
from wfsobs.closed_loop.run import each_outcome
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.mirror import Law, Mirror
from wfsobs.control.mismatch import loops, pairs, radius, stack_weights, weigh
from wfsobs.control.true_plant import TruePlant
from wfsobs.evaluation.result import Row
from wfsobs.notebook import PlotAccessor, import_extra
from wfsobs.priors_from.controllers import full_plant_of, own_settings, plant_of, prior_for
from wfsobs.priors_from.scenario import told_spectra
from wfsobs.progress import QUIET, Watch
from wfsobs.registry import name_list
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError, check_kind, error_line
from wfsobs.signal.wiener import in_two_threads
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.true_spectra import TrueSpectra, has_known_spectra, true_spectra
from wfsobs.typing import Array

if TYPE_CHECKING:
    import pandas

POINTS = 1000

BINS = 16
"""Parts of the range of an error in `PlantEnvelope.curves`."""

AT_ONCE = 2**21
"""Numbers in the largest array of a block of plants."""


@dataclass(frozen=True)
class Uncertainty:
    """Largest errors either way: delay [frames], gain and resonance of the mirror over themselves, rotation [deg]."""

    delay: float = 0.5
    gain: float = 0.2
    rotation: float = 10.0
    resonance: float = 0.1


@dataclass(frozen=True)
class Spread:
    """What one controller leaves over the envelope.

    Attributes
    ----------
    nominal : Array
        rms of the residual at the plant of the scenario, per mode [um]; infinite where it is not stable.
    points, corners : Array
        The same at the points and corners, (n, n_modes); of a controller that is simulated the first points alone.
    caution : float
        `control.caution` that it was designed with.
    is_simulated : bool
        Whether it is what is left of one record, which scatters, and not the expectation.
    """

    controller: str
    nominal: Array
    points: Array
    corners: Array
    caution: float = 1.0
    is_simulated: bool = False

    @property
    def unstable(self) -> int:
        """Points that are not stable."""
        return int(np.isinf(self.points).any(axis=1).sum())

    @property
    def unstable_interval(self) -> tuple[float, float]:
        """95 % interval of their share, of as many independent points (Clopper and Pearson), whose scatter Sobol's is below."""
        found = scipy.stats.binomtest(self.unstable, len(self.points)).proportion_ci(0.95, "exact")
        return float(found.low), float(found.high)

    @property
    def worst(self) -> Array:
        """Largest rms of points and corners, per mode [um]; infinite where one is not stable."""
        return np.concatenate([self.points, self.corners]).max(axis=0)

    @property
    def p95(self) -> Array:
        """95 % quantile of the rms at the points, per mode [um]; infinite where more than 5 % are not stable."""
        return np.quantile(self.points, 0.95, axis=0, method="higher")

    def summary(self, mode: int) -> tuple[float | None, float | None]:
        """(mean, 95 % quantile) of the rms at the stable points [um]."""
        stable = self.points[np.isfinite(self.points).all(axis=1), mode]
        return (float(stable.mean()), float(np.quantile(stable, 0.95))) if stable.size else (None, None)


@dataclass(frozen=True)
class PlantEnvelope:
    """Controllers over an uncertain plant.

    Attributes
    ----------
    errors : dict of str to Array
        delay [frames], gain, rotation [deg] and resonance -> the errors at the points, (n,).
    corner_errors : dict of str to Array
        The same at the corners.
    spreads : tuple of Spread
        One per controller.
    notes : dict of str to str
        Controllers that are not there, and why.
    """

    scenario: Scenario
    uncertainty: Uncertainty
    errors: dict[str, Array]
    corner_errors: dict[str, Array]
    spreads: tuple[Spread, ...]
    notes: dict[str, str] = field(default_factory=dict)
    plot: ClassVar[PlotAccessor] = PlotAccessor()

    def __repr__(self) -> str:
        return f"PlantEnvelope({len(self.spreads)} controllers, {len(next(iter(self.errors.values())))} points)"

    def rows(self) -> list[Row]:
        """Return one plain dictionary per controller and mode: the keys of `wfsobs envelope --json`.

        nominal_rms_nm, mean_rms_nm, p95_rms_nm, worst_rms_nm : null where not stable; mean and 95 % of the stable points
        unstable_share, unstable_low, unstable_high : of the points, and its 95 % interval
        unstable_corners : how many of `corners`
        points, simulated : how many, and whether by simulation and not by theory
        """
        out = []
        for spread in self.spreads:
            low, high = spread.unstable_interval
            for i, mode in enumerate(self.scenario.modes):
                mean, most = spread.summary(i)
                numbers = {"nominal": spread.nominal[i], "mean": mean, "p95": most, "worst": spread.worst[i]}
                out.append(
                    {
                        "controller": spread.controller,
                        "mode": mode.name,
                        "caution": spread.caution,
                        "points": len(spread.points),
                        "simulated": spread.is_simulated,
                        **{f"{k}_rms_nm": None if x is None or np.isinf(x) else float(x) * 1e3 for k, x in numbers.items()},
                        "unstable_share": spread.unstable / len(spread.points),
                        "unstable_low": low,
                        "unstable_high": high,
                        "unstable_corners": int(np.isinf(spread.corners).any(axis=1).sum()),
                        "corners": len(spread.corners),
                    }
                )
        return out

    def to_dataframe(self) -> pandas.DataFrame:
        """Return `rows` as a pandas table. Raises ImportError without pandas."""
        return import_extra("pandas", "arrays").DataFrame(self.rows())

    def ranking(self, *, by_worst: bool = False) -> list[str]:
        """Return controllers by the rms of all modes together at the nominal or the worst plant; unstable ones by their share."""

        def key(spread: Spread) -> tuple[float, float]:
            left = float(np.sqrt(np.sum((spread.worst if by_worst else spread.nominal) ** 2)))
            return left, spread.unstable if left == inf else 0

        return [spread.controller for spread in sorted(self.spreads, key=key)]

    @property
    def ranges(self) -> str:
        """The largest errors, in words."""
        of = self.uncertainty
        names = {"delay": f"delay +-{of.delay:g} frames", "gain": f"gain +-{100.0 * of.gain:g} %"}
        names |= {"rotation": f"rotation +-{of.rotation:g} deg", "resonance": f"resonance +-{100.0 * of.resonance:g} %"}
        return ", ".join(names[name] for name in self.errors)

    def curves(self, over: str, mode: int) -> dict[str, tuple[Array, Array, Array]]:
        """Return (error, mean rms, largest rms [um]), (BINS,) each, of the stable points in parts of the range of an error.

        By controller; over : a key of `errors`; NaN where no point of a part is stable
        """
        errors = self.errors[over]
        edges = np.linspace(errors.min(), errors.max(), BINS + 1)
        inside = np.clip(np.digitize(errors, edges) - 1, 0, BINS - 1) == np.arange(BINS)[:, None]
        out = {}
        for spread in self.spreads:
            rms = spread.points[:, mode]
            counted = inside[:, : len(rms)] & np.isfinite(rms)
            total, n = np.where(counted, rms, 0.0).sum(axis=1), counted.sum(axis=1)
            mean = np.where(n > 0, total / np.maximum(n, 1), np.nan)
            most = np.where(n > 0, np.where(counted, rms, 0.0).max(axis=1), np.nan)
            out[spread.controller] = 0.5 * (edges[:-1] + edges[1:]), mean, most
        return out

    def sentences(self, scale: float = 1e3, unit: str = "nm", mode: int | None = None) -> list[str]:
        """Return which controller leaves least at the worst plant, at what cost, and which are not stable.

        scale : from [um] to the unit;  mode : column, None for all modes together. Empty without controllers.
        """

        def left(spread: Spread, at: str) -> float:
            rms = getattr(spread, at)
            return float(np.sqrt(np.sum(rms**2)) if mode is None else rms[mode])

        def text(spread: Spread, at: str) -> str:
            rms = left(spread, at)
            return "unstable" if rms == inf else f"{scale * rms:.3g} {unit}"

        spreads = [one for one in self.spreads if not one.is_simulated] or self.spreads  # one record is not the expectation
        if not spreads:
            return []
        first, safest = (min(spreads, key=lambda one: left(one, at)) for at in ("nominal", "worst"))
        of_first, of_safest = (CONTROLLERS[one.controller].label for one in (first, safest))
        where = f"With the plant uncertain ({self.ranges})"
        if left(safest, "worst") == inf:
            out = [f"{where} no controller is stable everywhere."]
        else:
            worst, nominal = (text(safest, at) for at in ("worst", "nominal"))
            out = [f"{where}, {of_safest} leaves least at the worst plant: {worst}, {nominal} at the nominal one."]
        if first is not safest:
            nominal, worst = (text(first, at) for at in ("nominal", "worst"))
            out.append(f"{of_first} leaves least at the nominal plant: {nominal}, {worst} at the worst.")
        for spread in self.spreads:
            if left(spread, "worst") == inf:
                share = 100.0 * spread.unstable / len(spread.points)
                at = f"for {share:.2g} % of the plants" if spread.unstable else "at corners"
                out.append(f"{CONTROLLERS[spread.controller].label} is unstable {at}.")
        return out


@dataclass(frozen=True)
class Plants:
    """Plants of an envelope: the nominal one, those at the points and those at the corners."""

    nominal: TruePlant
    points: Sequence[TruePlant]
    corners: Sequence[TruePlant]


def plant_envelope(
    scenario: Scenario,
    *,
    controllers: Sequence[str] | None = None,
    uncertainty: Uncertainty | None = None,
    points: int = POINTS,
    simulation_points: int = 0,
    on_spread: Callable[[PlantEnvelope], None] | None = None,
    watch: Watch = QUIET,
) -> PlantEnvelope:
    """Compute what every linear controller leaves over an uncertain plant, and by simulation what others leave.

    Parameters
    ----------
    scenario : Scenario
        Settings; the plant that the errors are around is that of `plant`, which must be linear and time-invariant.
    controllers : sequence of str, optional
        Ids of the controllers; by default all.
    uncertainty : Uncertainty, optional
        Largest errors.
    points : int
        Points of Sobol's sequence; corners come on top.
    simulation_points : int
        First points at which controllers that are not linear are simulated, and corners; by default they are left out.
    on_spread : callable, optional
        Receives what there is after every controller, and after every plant of one that is simulated.
    watch : Watch, optional
        Receives the progress, and is asked whether to stop.

    Returns
    -------
    PlantEnvelope
        Residuals at all points.

    Raises
    ------
    SettingError
        There are no points, the spectra are not known, the plant is not linear, a delay would be below one frame, or a
        controller is unknown.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    wfsobs.close_loop : Simulate the loop with one plant.
    wfsobs.tune : Tune a controller on an uncertain plant.
    """
    check_kind("plant_envelope", scenario, Scenario)
    of = uncertainty or Uncertainty()
    errors, corners, plants = uncertain_plants(scenario, of, points)
    spectra = known_spectra(scenario)
    names = [c.id for c in select_controllers(controllers) if not c.is_idle] if simulation_points else with_laws(controllers)
    names.sort(key=lambda name: not CONTROLLERS[name].is_linear)
    spreads, notes = dict[str, Spread](), dict[str, str]()
    first = replace(plants, points=plants.points[:simulation_points])

    def found() -> PlantEnvelope:
        return PlantEnvelope(scenario, of, errors, corners, tuple(spreads.values()), dict(notes))

    for i, name in enumerate(names):
        watch.check()
        try:
            if simulation_points and not CONTROLLERS[name].is_linear:
                for spread in simulated_spreads(name, scenario, first, watch.part(i / len(names), 1.0 / len(names))):
                    spreads[name] = spread
                    if on_spread:
                        on_spread(found())
            else:
                spreads[name] = spread_of(name, scenario, plants, spectra, watch)
        except ValueError as error:
            notes[name] = error_line(error)
        watch.step((i + 1) / len(names))
        if on_spread:
            on_spread(found())
    return found()


def with_laws(controllers: Sequence[str] | None) -> list[str]:
    """Return those of some controllers, by default of all, that have linear laws. Raises SettingError for none."""
    controllers = name_list(controllers)
    out = [c.id for c in select_controllers(controllers) if c.law is not None]
    if not out:
        linear = [c.id for c in CONTROLLERS.values() if c.law is not None and c.is_quick]
        raise SettingError(f"controllers: an envelope takes {', '.join(linear)}, not {', '.join(controllers or ())}")
    return out


def known_spectra(scenario: Scenario) -> list[TrueSpectra]:
    """Return the true spectra of all modes. Raises SettingError where they are not known."""
    if not has_known_spectra(scenario):
        raise SettingError("the spectra of this scenario are not known for the whole record, and so is no residual by theory")
    return [true_spectra(scenario, mode) for mode in range(len(scenario.modes))]


def uncertain_plants(
    scenario: Scenario, uncertainty: Uncertainty, points: int
) -> tuple[dict[str, Array], dict[str, Array], Plants]:
    """Return errors at the points and at the corners, as `error_samples`, and the plants. Raises SettingError."""
    base = full_plant_of(scenario)
    if points < 1:
        raise SettingError(f"points = {points}: takes a whole number from 1")
    if not base.time_invariant:
        raise SettingError("plant: an envelope is by theory, for a plant that is linear and the same at every step")
    if base.delay - uncertainty.delay < 1.0:
        raise SettingError(f"delay: {base.delay:g} - {uncertainty.delay:g} frames are below 1")
    errors, corners = error_samples(uncertainty, base, points)

    def plants(of: dict[str, Array]) -> list[TruePlant]:
        return [plant_at(scenario, base, {k: float(x[i]) for k, x in of.items()}) for i in range(len(of["delay"]))]

    return errors, corners, Plants(base, plants(errors), plants(corners))


def spread_of(name: str, scenario: Scenario, plants: Plants, spectra: Sequence[TrueSpectra], watch: Watch) -> Spread:
    """Return what a controller leaves of these plants. Raises ValueError saying why it cannot, Cancelled."""
    controller, told = CONTROLLERS[name], [told_spectra(one) for one in spectra]
    if controller.law is None or controller.predict is not None:
        raise ValueError("its prediction is not linear: by simulation alone (--simulate N, `simulation_points=N`)")
    prior, plant = prior_for(controller, scenario, told), plant_of(scenario)
    laws = controller.laws(prior, plant, own_settings(controller, scenario), len(spectra))
    if not all(law.stable for law in laws):
        raise ValueError("not stable")
    left = residuals(laws, plant.mirror, [plants.nominal, *plants.points, *plants.corners], [spectra], watch)
    end = 1 + len(plants.points)
    return Spread(name, left[0], left[1:end], left[end:], scenario.control.caution)


def simulated_spreads(name: str, scenario: Scenario, plants: Plants, watch: Watch) -> Iterator[Spread]:
    """Yield what a controller leaves of these plants in one record, the points one by one. Raises ValueError, Cancelled."""
    believed = scenario.replace({f"plant.{key}": value for key, value in type(scenario)().plant.to_dict().items()})
    plan, record = design(believed, [name]), simulate(believed, watch=watch.silent)
    total = 1 + len(plants.corners) + len(plants.points)

    def left(plant: TruePlant, number: int) -> Array:
        (outcome,) = each_outcome(record, replace(plan, true=plant), watch.part(number / total, 1.0 / total), [name])
        if outcome.residual is None:
            if None in outcome.stable:
                raise ValueError(outcome.note)
            return np.full(record.n_modes, inf)
        start = round(max(plan.start, outcome.own_from) / record.dt)
        return np.sqrt(np.square(outcome.residual[start:]).mean(axis=0))

    nominal = left(plants.nominal, 0)
    corners = np.array([left(plant, 1 + i) for i, plant in enumerate(plants.corners)])
    points = list[Array]()
    for plant in plants.points:
        points.append(left(plant, 1 + len(corners) + len(points)))
        yield Spread(name, nominal, np.array(points), corners, scenario.control.caution, is_simulated=True)


def error_samples(uncertainty: Uncertainty, base: TruePlant, points: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the errors by name at the points, (points,), and at all corners; of a resonance where the mirror has one."""
    most = {"delay": uncertainty.delay, "gain": uncertainty.gain, "rotation": uncertainty.rotation}
    if len(base.matrix) == 1:
        del most["rotation"]
    if base.resonance:
        most["resonance"] = uncertainty.resonance
    power = ceil(log2(points))
    first = scipy.stats.qmc.Sobol(len(most), scramble=False).random_base2(power)[:points]
    cube = first + 0.5 ** (power + 1)  # in the middle of the cells
    corners = np.array(list(product((-1.0, 1.0), repeat=len(most))))
    by = list(enumerate(most.items()))
    return {k: x * (2.0 * cube[:, i] - 1.0) for i, (k, x) in by}, {k: x * corners[:, i] for i, (k, x) in by}


def plant_at(scenario: Scenario, base: TruePlant, errors: dict[str, float]) -> TruePlant:
    """Return the plant of a scenario with further errors, on gain and resonance as factors 1 + error."""
    turned = full_plant_of(scenario, errors.get("rotation", 0.0)).matrix
    return replace(
        base,
        matrix=(1.0 + errors["gain"]) * turned,
        delay=base.delay + errors["delay"],
        resonance=base.resonance * (1.0 + errors.get("resonance", 0.0)),
    )


def residuals(
    laws: Sequence[Law],
    nominal: Mirror,
    plants: Sequence[TruePlant],
    spectra: Sequence[Sequence[TrueSpectra]],
    watch: Watch = QUIET,
) -> Array:
    """Rms of the residual [um] of every plant and mode, (plants, modes), infinite where a loop is not stable.

    spectra : of the modes, once for all plants or for each
    """
    matrices = np.array([plant.matrix for plant in plants])
    out = np.empty(matrices.shape[:2])
    for columns in pairs(np.abs(matrices).max(axis=0)):
        mine = [laws[column] for column in columns]
        of = loops(mine, nominal, is_coarse=True)
        common = [weigh(loop_spectra(spectra[0][column]), of) for column in columns] if len(spectra) == 1 else []
        images, size = of.images, len(columns) * of.K.shape[-1]
        block = max(1, AT_ONCE // (of.omega.size * size * size))
        parts = [slice(i, i + block) for i in range(0, len(plants), block)]

        def one(part: slice, of=of, common=common, images=images, columns=columns, mine=mine) -> Array:
            watch.check()
            chosen = plants[part]
            response = np.array([plant.response(images) for plant in chosen])
            matrix = matrices[part][:, columns][:, :, columns]
            determinant, Q = of.solve(response, matrix)
            stable, is_sure = of.stable(determinant)
            for i in np.flatnonzero(~is_sure).tolist():
                stable[i] = radius(mine, nominal, replace(chosen[i], matrix=matrix[i])) < 1.0
            each = (stack_weights([weigh(loop_spectra(own[column]), of) for own in spectra[part]]) for column in columns)
            weights = common or list(each)
            left = of.residual(Q, response, matrix, weights)
            return np.where(stable[:, None], np.sqrt(np.maximum(left, 0.0)), inf)

        out[:, columns] = np.concatenate(in_two_threads(one, parts))
    return out
