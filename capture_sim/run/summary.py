"""Main results of a run, by their keys in results.json."""

from __future__ import annotations

import copy
import functools
import json
from typing import Any, NamedTuple

import numpy as np

from capture_sim.dynamics.samples import EXTREMES, TOUCH, Extremes
from capture_sim.run.loads import NEAREST_ERROR, bounds_of_loads, loads_of
from capture_sim.run.series import at_rate


def sample_rate(samples: np.ndarray) -> float:
    """Return the sample rate of a run, Hz, from its median interval; 0 if unknown."""
    interval = float(np.median(np.diff(samples["t"]))) if samples.size > 1 else 0.0
    return 1.0 / interval if interval > 0.0 else 0.0


def end_and_residual(samples: np.ndarray, rate: float) -> tuple[float, float]:
    """Return the time of the last sample, s, and the largest residual of the energy ledger, J.

    Only samples on the grid of ``rate``, Hz, count for the residual, which is NaN if they do not
    have it.  Without samples both are 0.
    """
    if not samples.size:
        return 0.0, 0.0
    residual = samples["energy_residual"][at_rate(samples["t"], rate)]
    return float(samples["t"][-1]), float(np.abs(residual).max(initial=0.0))


class _Kind(NamedTuple):
    """What the value of a key may be, and the value in rows that lack the key."""

    types: type | tuple[type, ...]
    default: Any
    text: str


_NUMBER = _Kind((int, float), None, "a number or null")
_TEXT, _NAME = _Kind(str, "", "a text"), _Kind(str, None, "a text or null")
_FLAG = _Kind(bool, False, "true or false")
_LINES, _OBJECT = _Kind(list, [], "a list"), _Kind(dict, {}, "an object")


class Key(NamedTuple):
    """A key of a row: the unit and the meaning of its value, and its kind."""

    unit: str
    meaning: str
    kind: _Kind = _NUMBER


#: Key of a row of ``results.json`` for the file name of the recording; null without a recording.
RECORDING = "recording"
#: The keys in the order of a row; the loads (:data:`LOADS`) follow :data:`NEAREST_ERROR`.
KEYS = {
    "name": Key("", "run", _TEXT),
    "verdict": Key("", "the detector's verdict; `null`: nothing to detect with", _NAME),
    "verdict_time": Key("s", "begin of the verdict's state, since the release"),
    "verdict_time_low": Key("s", "earliest time at which it may have begun: noise and gaps"),
    "verdict_time_high": Key(
        "s", "latest time at which it may have begun; `null`: none is certain"
    ),
    "left_again": Key("", "true: a captured tip has left the capture zone again", _FLAG),
    "not_used": Key("", "measurements that the detector did not use", _TEXT),
    "problems": Key("", "why the run or its recording is incomplete", _LINES),
    "doubts": Key(
        "",
        "[rules of plausibility](what_your_recording_must_hold.md) that the measurements break",
        _LINES,
    ),
    "waived": Key("", "names of rules that were not checked", _LINES),
    "impact_speed": Key("m/s", "speed of the chaser relative to the target at the first touch"),
    "impact_speed_missing": Key(
        "", "why a rig's bag gives no impact speed; empty if it does", _TEXT
    ),
    "impact_speed_error": Key("m/s", "standard error of `impact_speed`; 0: exact"),
    "first_contact_time": Key("s", "start of the first contact, since the release"),
    "first_contact_time_low": Key("s", "time up to which the measurements exclude it"),
    "first_contact_time_high": Key("s", "time by which they show it"),
    "first_contact_duration": Key("s", "from its first touch to the end of its last one"),
    "first_contact_touches": Key("1", "number of touches in it"),
    "first_contact_peak_force": Key("N", "largest normal force in it"),
    "first_contact_impulse": Key("N s", "normal impulse of its touches"),
    "touches": Key("1", "number of touches in the run"),
    "normal_impulse": Key("N s", "normal impulse of all touches"),
    NEAREST_ERROR: Key(
        "m", "standard error of `nearest_distance`; 0: exact, `null`: noise hides it"
    ),
    "loads_from": Key(
        "", "`integration`, or the samples and their rate", _Kind(str, "integration", "a text")
    ),
    "energy_residual": Key("J", "largest residual of the energy ledger"),
    "wall_time": Key("s", "duration of the computation"),
    "real_time_factor": Key("1", "simulated time over `wall_time`"),
    "made_by": Key("", "scene, overrides, hash, seed and software", _OBJECT),
    RECORDING: Key("", "file of the recording beside the table; `null` without one", _NAME),
}
#: Keys of a row that are not results of the run, but describe its file, computation or origin.
NOT_NUMBERS = {RECORDING, "wall_time", "real_time_factor", "made_by"}


def row_from(entry: object, where: str) -> dict[str, Any]:
    """Return a row of ``results.json``, written by any version, with all keys of this version.

    A key that the entry lacks gets its default.  The keys are in the order of :data:`KEYS`; those
    of a newer version follow.  If the entry is not a valid row, ValueError is raised with a message
    that begins with ``where``.
    """
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise ValueError(f"{where}: name: must be a text")
    kinds = _kinds()
    defaults = {key: copy.copy(kind.default) for key, kind in kinds.items()}
    row = {**defaults, **_with_names_of_today(entry)}
    for key, kind in kinds.items():
        value = row[key]
        is_null = value is None and kind.default is None
        is_right = isinstance(value, kind.types) and isinstance(value, bool) == (kind is _FLAG)
        if not is_null and not is_right:
            raise ValueError(f"{where}: {key} = {json.dumps(value)[:40]}: must be {kind.text}")
    return row


#: Keys of results.json of version 0.1.0, and the present keys of these values.
FIRST_NAMES = {
    "peak_force": "max_normal_force",
    "max_axial_stroke": "max_axial_stroke_in_before_latch",
    "max_torsion": "max_torsion_before_latch",
}
#: Keys of version 0.1.0 for the largest value after the latch has closed.  With each come the key
#: for the time before, and the present key for the whole run.
_FIRST_LATCHED = {
    "max_axial_stroke_latched": ("max_axial_stroke", "max_axial_stroke_in"),
    "max_torsion_latched": ("max_torsion", "max_torsion"),
}


def _with_names_of_today(entry: dict[str, Any]) -> dict[str, Any]:
    """Return a row of results.json with the keys of version 0.1.0 replaced by the present keys.

    A row without keys of version 0.1.0 is returned unchanged.
    """
    if not entry.keys() & _FIRST_LATCHED.keys():
        return entry
    former = {*FIRST_NAMES, *_FIRST_LATCHED}
    row = {key: value for key, value in entry.items() if key not in former}
    row |= {new: entry[old] for old, new in FIRST_NAMES.items() if old in entry}
    for latched, (before, whole) in _FIRST_LATCHED.items():
        values = (entry.get(before), entry.get(latched))
        row[whole] = max((x for x in values if isinstance(x, int | float)), default=None)
    return row


def row_without_results(name: str, problem: str) -> dict[str, Any]:
    """Return the row of a recording without results; ``problem`` is the reason, one line."""
    return {**row_from({"name": name}, name), "problems": [problem]}


@functools.cache
def _kinds() -> dict[str, _Kind]:
    """Return the kind of each key of a row, in the order of a row."""
    kinds: dict[str, _Kind] = {}
    for key, (_, _, kind) in KEYS.items():
        kinds[key] = kind
        if key == NEAREST_ERROR:
            nothing = Extremes(np.zeros(1, EXTREMES)[0], None)
            loads = loads_of(nothing, np.zeros(0, TOUCH))
            kinds |= dict.fromkeys([*loads, *bounds_of_loads(loads, None)], _NUMBER)
    return kinds
