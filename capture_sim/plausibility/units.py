"""Rules of units: are lengths in m and angles in rad?"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.rules import Grade, Said, rule
from capture_sim.plausibility.signals import noise

#: Units of length that drivers send in place of m, with their size in m.
LENGTHS = {"mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "foot": 0.3048}
#: Positions are doubted if the vehicles always stay further apart than the first number times the
#: distance at contact, or always nearer than the second number times that distance.
_FAR, _NEAR = 10.0, 0.5
#: Without a scene, positions are doubted if the vehicles always stay further apart than this, m.
_MAX_BENCH_SIZE = 20.0
#: A stroke or torsion is in another unit if it exceeds this number times the deflection that the
#: kinetic energy of the approach can cause.
_ENERGY_MARGIN = 8.0
#: Least limits of stroke, m, and torsion, rad, whatever the energy.
_MIN_STROKE_LIMIT, _MIN_TORSION_LIMIT = 0.05, 0.1
#: The unit of an encoder is doubted if its noise is above this, m (stroke) and rad (torsion).
_MAX_NOISE = (2e-3, 2e-2)
#: Strokes beyond a stop by this are doubted, m: stops yield, and encoders have an offset.
_STOP_MARGIN = 2e-3


@rule(
    "position_units",
    Grade.REFUSED,
    compares="smallest distance between chaser and target",
    threshold="> 10 times that at contact by the scene, or always < half of it (without a scene: "
    "> 20 m)",
    reason="mm makes it 1000, inch 39 times too large; a trial that misses stays below 10, and "
    "below a half the bodies overlap",
    needs=("poses",),
)
def position_units(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the distance between the vehicles shows that positions are not in m."""
    if motion.pair is None:
        return
    nearest = float(np.percentile(motion.distance, 2.0))
    topic = motion.pair_topic
    if motion.scene is None:
        if nearest > _MAX_BENCH_SIZE:
            yield Said(
                topic,
                f"distance between the vehicles never below {nearest:.4g} m: must be a few m; "
                "positions look like mm; have the driver send m",
            )
        return
    expected = motion.contact_distance
    furthest = float(np.percentile(motion.distance, 90.0))
    if nearest <= _FAR * expected and furthest >= _NEAR * expected:
        return
    unit = _unit_of(motion, expected)
    if furthest < _NEAR * expected and (furthest < 0.02 or not unit):
        return  # bodies_overlap
    look = f"positions look like {unit}" if unit else "positions are in no unit that is known"
    yield Said(
        topic,
        f"distance between the vehicles {nearest:.4g} m at the least: must be "
        f"{expected:.3g} m at contact; {look}; have the driver send m",
    )


def _unit_of(motion: MeasuredMotion, expected: float) -> str:
    """Return the unit in which the positions seem to be, e.g. "mm (the chaser's)"; "" if unknown.

    In that unit, the smallest distance between the vehicles is 0.6 to 3 times ``expected``, the
    distance at contact, m.  Positions of both vehicles or of one of them may be in that unit.
    """
    assert motion.pair is not None
    of_c, of_t = motion.pair.chaser[:, :2], motion.pair.target[:, :2]
    # both vehicles before one alone: a small factor of one hides its position altogether
    for name, (has_c, has_t) in {
        "": (True, True),
        " (the chaser's)": (True, False),
        " (the target's)": (False, True),
    }.items():
        for unit, factor in LENGTHS.items():
            by_c, by_t = factor if has_c else 1.0, factor if has_t else 1.0
            distance = np.hypot(*(by_t * of_t - by_c * of_c).T)
            if 0.6 * expected < float(np.percentile(distance, 2.0)) < 3.0 * expected:
                return unit + name
    return ""


@rule(
    "buffer_units",
    Grade.REFUSED,
    compares="largest stroke with the probe, and stroke and torsion with the approach's energy",
    threshold="stroke > the probe's length, or either > 8 times what that energy can deflect "
    "(at least 0.05 m and 0.1 rad), or noise > 2 mm or 20 mrad",
    reason="mm makes a stroke 1000, inch 39, deg a torsion 57 times too large; a push by hand "
    "stays below",
    needs=("scene", "buffer"),
)
def buffer_units(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each of stroke (if not in m) and torsion (if not in rad).

    Noise that is too large for m and rad makes a single finding for both.
    """
    buffer, scene = motion.buffer, motion.scene
    if buffer is None or scene is None:
        return
    kept = buffer.is_measured
    scatter = noise(buffer.stroke[kept]), noise(buffer.torsion[kept])
    if scatter[0] > _MAX_NOISE[0] or scatter[1] > _MAX_NOISE[1]:
        yield Said(
            buffer.topic,
            f"noise {scatter[0]:.3g} m of the stroke, {scatter[1]:.3g} rad of the torsion: must be "
            f"below {_MAX_NOISE[0]:g} m and {_MAX_NOISE[1]:g} rad; they look like mm or deg; "
            "have the driver send m and rad",
        )
        return
    stroke = float(np.percentile(np.abs(buffer.stroke[kept]), 99.8))
    torsion = float(np.percentile(np.abs(buffer.torsion[kept]), 99.8))
    energy = 0.5 * scene.chaser_total_mass * _speed(motion) ** 2
    k_A, k_T = scene.buffer.stiffness_at_rest, scene.buffer.k_T
    by_energy = math.sqrt(2.0 * energy / k_A) if k_A > 0.0 else scene.rest_length
    limit = min(scene.rest_length, max(_ENERGY_MARGIN * by_energy, _MIN_STROKE_LIMIT))
    if stroke > limit:
        unit = _deflection_unit(stroke, by_energy, {"mm": 1e-3, "inch": 0.0254})
        yield Said(
            buffer.topic,
            f"stroke {stroke:.4g} m: must be below {limit:.3g} m; strokes look like {unit}; have "
            "the driver send m",
        )
    turned = math.sqrt(2.0 * energy / k_T) if k_T > 0.0 else math.pi
    limit = max(_ENERGY_MARGIN * turned, _MIN_TORSION_LIMIT)
    if torsion > limit:
        turns = round(float(np.median(buffer.torsion[kept])) / math.tau)
        rest = float(np.percentile(np.abs(buffer.torsion[kept] - turns * math.tau), 99.8))
        unit = _deflection_unit(torsion, turned, {"mrad": 1e-3, "deg": math.pi / 180.0})
        look = f"torsions look like {unit}; have the driver send rad"
        if turns and rest <= limit:
            look = f"it is off by {turns:+d} turn{'s' if abs(turns) > 1 else ''}; set its zero"
        yield Said(
            buffer.topic,
            f"torsion {torsion:.4g} rad: must be below {limit:.3g} rad; {look}",
        )


def _deflection_unit(value: float, largest: float, units: dict[str, float]) -> str:
    fitting = [unit for unit, factor in units.items() if factor * value <= 1.5 * largest]
    return fitting[-1] if fitting else "another unit"


def _speed(motion: MeasuredMotion) -> float:
    """Return the largest relative speed of the vehicles in the approach by the scene, m/s.

    It is the largest of the speeds of the launch plan, the relative initial speed and 0.05 m/s.
    Measured poses are not used.
    """
    from capture_sim.scene.launch_plan import plan_launch

    assert motion.scene is not None
    scene = motion.scene
    chaser, target, plan = scene.initial.chaser, scene.initial.target, plan_launch(scene)
    relative = math.hypot(chaser.vx - target.vx, chaser.vy - target.vy)
    return max(0.05, plan.landing_speed, plan.impact_speed, relative)


@rule(
    "beyond_stop",
    Grade.NOTED,
    compares="stroke with the stops and the seat of the scene",
    threshold="0.2 % of the strokes beyond by > 2 mm",
    reason="stops yield, and an encoder's zero may be off",
    needs=("scene", "buffer"),
)
def beyond_stop(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each stop or seat of the scene that the stroke exceeds by over 2 mm."""
    buffer, scene = motion.buffer, motion.scene
    if buffer is None or scene is None:
        return
    stroke = buffer.stroke[buffer.is_measured]
    outward = scene.outward_stroke
    inward = None if scene.stops is None else scene.stops.compression
    low, high = np.percentile(stroke, [0.2, 99.8])
    if outward is not None and high > outward + _STOP_MARGIN:
        yield Said(
            buffer.topic,
            f"stroke {1e3 * high:.3g} mm: must be {1e3 * outward:.3g} mm or less, where the probe "
            "meets its stop; check the encoder's zero and sign",
        )
    if inward is not None and -low > inward + _STOP_MARGIN:
        yield Said(
            buffer.topic,
            f"stroke {1e3 * low:.3g} mm: must be -{1e3 * inward:.3g} mm or more, where the probe "
            "meets its stop; check the encoder's zero and unit",
        )
