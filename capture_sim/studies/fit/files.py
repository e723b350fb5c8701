"""The files of a calibration: JSON and scene to write, and the results that other studies read."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.run.origin import scene_origin
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import expanded
from capture_sim.studies.fit.parameters import SENSOR_ERRORS
from capture_sim.studies.fit.prediction import Prediction
from capture_sim.studies.fit.result import STARTS, Calibration
from capture_sim.studies.vary.inputs import Known

#: Kind and version of the file.
KIND, VERSION = "capture_sim calibration", 1
#: Names of the files in a folder of a calibration.
JSON, SCENE = "calibration.json", "calibrated.yaml"
#: Largest size of a file that is read, bytes.
_LARGEST = 50_000_000


def as_data(found: Calibration, hashes: Mapping[str, str]) -> dict[str, Any]:
    """Return a calibration as plain data for JSON, in SI units.

    Values, errors and scores that are not finite become None.  ``hashes``: SHA-256 of each
    recording by its path.
    """
    origin = scene_origin(found.scene)
    return {
        "kind": KIND,
        "version": VERSION,
        "is_found": found.is_found,
        "verdict": found.verdict,
        "findings": [{"kind": f.kind, "text": f.text, "advice": f.advice} for f in found.findings],
        "names": list(found.names),
        "values": _plain(found.values),
        "errors": _plain(found.errors),
        "units": list(found.units),
        "begun": _plain(found.begun),
        "covariance": _plain(found.covariance),
        "weighed": {
            name: {"value": w.value, "error": w.error} for name, w in found.weighed.items()
        },
        "notes": list(found.notes),
        "noise_errors": _plain(found.noise_errors),
        "held": [
            {
                "name": one.name,
                "value": one.value,
                "error": one.error,
                "unit": one.unit,
                "fitted": one.fitted,
                "known_to": one.known_to,
                "moves": dict(zip(found.names, _plain(one.moves), strict=True)),
            }
            for one in found.held
        ],
        "profiles": [
            {
                "name": profile.name,
                "values": _plain(profile.values),
                "rises": _plain(profile.rises),
                "is_gaussian": profile.is_gaussian,
            }
            for profile in found.profiles
        ],
        "trials": [
            {
                "recording": start.trial,
                "sha256": hashes.get(start.trial),
                "start": dict(zip(STARTS, _plain(start.values), strict=True)),
                "start_errors": dict(zip(STARTS, _plain(start.errors), strict=True)),
                "release": start.release,
                "release_error": start.release_error if start.is_release_fitted else 0.0,
                "used_until": start.end,
                "hold": start.cut if math.isfinite(start.cut) else None,
                "noise": {name: _plain(sigma) for name, sigma in start.noise.items()},
            }
            for start in found.starts
        ],
        "chi2": found.chi2,
        "freedom": found.freedom,
        "left": found.left,
        "restarts": [{"chi2_above": a, "standard_errors": b} for a, b in found.restarts],
        "agreement": found.agreement._asdict(),
        "agreements": [one._asdict() for one in found.agreements],
        "block_means": [block._asdict() for block in found.blocks],
        "scores": [_score(score._asdict()) for score in found.scores],
        "lacking": [
            {
                "name": one.score.name,
                "estimate": one.estimate,
                "error": one.error if math.isfinite(one.error) else None,
                "gain": one.gain,
                "rivals": list(one.rivals),
            }
            for one in found.lacking
        ],
        "simulations": found.simulations,
        "scene": origin["scene"],
        "scene_sha256": origin["scene_sha256"],
        "prediction": None if found.prediction is None else _prediction(found.prediction),
    }


def _plain(values: np.ndarray) -> Any:
    """Return an array as nested lists, with None for each number that is not finite."""
    plain = np.asarray(values, dtype=object)
    plain[~np.isfinite(np.asarray(values, dtype=float))] = None
    return plain.tolist()


def _score(fields: dict[str, Any]) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in fields.items()
    }


def _prediction(prediction: Prediction) -> dict[str, Any]:
    placement = prediction.placement
    return {
        "scene": prediction.scene.name,
        "placement": None
        if placement is None
        else {"position": placement.position, "angle": placement.angle},
        "figures": [_score(figure.__dict__) for figure in prediction.figures],
        "failed_draws": prediction.failed,
    }


@dataclass(frozen=True)
class Calibrated:
    """Results of a calibration, read from its file for other studies.

    ``names`` are those of the k parameters.  ``is_found`` is True if all tests of the fit passed;
    ``findings`` are the reasons why not.  ``verdict`` is that of :attr:`Calibration.verdict`.
    """

    path: str
    names: tuple[str, ...]
    values: np.ndarray  # (k,), SI
    covariance: np.ndarray  # (k, k), SI
    is_found: bool
    findings: tuple[str, ...]
    #: Held values by name: the scene's, and what the fit found of them with its standard error; SI.
    held: Mapping[str, tuple[float, Known]] = field(default_factory=dict)
    verdict: str = "found"

    @property
    def errors(self) -> np.ndarray:
        """Standard errors of the values (k,), SI."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def of_bench(self) -> list[int]:
        """Indices of the parameters that are fields of a scene, not errors of a sensor."""
        return [k for k, name in enumerate(self.names) if name not in SENSOR_ERRORS]

    def paths(self, k: int) -> tuple[str, ...]:
        """Return the paths in a scene of the parameter with index k."""
        return expanded(self.names[k])

    @property
    def fields(self) -> dict[str, float]:
        """Values of the scene's fields by path, SI; without errors of sensors."""
        return {path: float(self.values[k]) for k in self.of_bench for path in self.paths(k)}

    @property
    def weighed(self) -> dict[str, Known]:
        """Value and standard error of each scene parameter by name, as if it had been weighed.

        The correlations are lost.
        """
        return {
            self.names[k]: Known(float(self.values[k]), float(self.errors[k]))
            for k in self.of_bench
        }


def read_calibrated(path: Path) -> Calibrated:
    """Read a calibration from its JSON file, or from a folder that contains ``calibration.json``.

    Raise SceneError if it cannot be read, is not a calibration, or has an invalid covariance.
    """
    file = path / JSON if path.is_dir() else path
    try:
        if file.stat().st_size > _LARGEST:
            raise SceneError(f"{file}: must be a {JSON} of at most {_LARGEST / 1e6:g} MB")
        data = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{file}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise SceneError(f"{file}: is not JSON") from None
    try:
        if data["kind"] != KIND:
            raise KeyError("kind")
        names = tuple(map(str, data["names"]))
        values = np.array(data["values"], dtype=float)
        covariance = np.array(data["covariance"], dtype=float)
        findings = tuple(f"{f['text']}; {f['advice']}" for f in data["findings"])
        is_found = bool(data["is_found"])
        verdict = str(data.get("verdict", "found" if is_found else "not found"))
        # files of before held values joined have none
        held = {
            str(one["name"]): (
                float(one["value"]),
                Known(float(one["fitted"]), float(one["known_to"])),
            )
            for one in data.get("held", [])
        }
    except (KeyError, TypeError, ValueError):
        raise SceneError(f"{file}: must be a {JSON} of capture-sim calibrate") from None
    k = len(names)
    is_whole = values.shape == (k,) and covariance.shape == (k, k)
    if not is_whole or not np.isfinite(values).all() or not np.isfinite(covariance).all():
        raise SceneError(f"{file}: names, values and covariance do not belong together")
    if k and not np.linalg.eigvalsh(covariance)[0] > -1e-9 * np.trace(covariance):
        raise SceneError(f"{file}: covariance: must have no negative variance")
    return Calibrated(str(file), names, values, covariance, is_found, findings, held, verdict)


#: Factor on all correlations.  It keeps the correlation of two fields of one parameter below 1,
#: because the copula that draws them rejects 1.
_TIED = 1.0 - 1e-10


def calibrated_dispersions(
    calibrated: Calibrated, without: Collection[str] = ()
) -> tuple[dict[str, str], dict[tuple[str, str], float]]:
    """Return a normal distribution of each calibrated field by path, and the correlations.

    The distributions are texts such as ``normal(0.3, 0.01)`` in SI units.  The correlations have
    pairs of paths as keys; zeros are left out.  Fields in ``without`` and fields without an error
    are left out; this does not change the distributions of the other fields.
    """
    vary: dict[str, str] = {}
    owners: list[tuple[str, int]] = []
    for k in calibrated.of_bench:
        value, error = float(calibrated.values[k]), float(calibrated.errors[k])
        for path in calibrated.paths(k):
            if path not in without and error > 0.0:
                vary[path] = f"normal({value!r}, {error!r})"
                owners.append((path, k))
    correlations = {}
    for i, (first, k) in enumerate(owners):
        for second, m in owners[:i]:
            size = calibrated.errors[k] * calibrated.errors[m]
            r = float(calibrated.covariance[k, m] / size) * _TIED
            if r != 0.0:
                correlations[second, first] = r
    return vary, correlations


def scene_text(found: Calibration, scene: Scene, extends: str, title: str) -> str:
    """Return the text of ``calibrated.yaml``, a scene with the values that the fit found.

    It extends ``scene``, that of the trials, by its name ``extends``.  Findings are listed as
    comments.
    """
    lines = [
        f"# {title}",
        *(f"# {found.verdict}: {finding.text}" for finding in found.findings),
        f"extends: {extends}",
        f"title: {json.dumps(title)}",
    ]
    parts: dict[str, Any] = {}
    for path, value in found.fields_of(scene).items():
        inner = parts
        *owners, name = path.split(".")
        for owner in owners:
            inner = inner.setdefault(owner, {})
        inner[name] = value
    lines += _yaml(parts, 0)
    return "\n".join(lines) + "\n"


def _yaml(parts: Mapping[str, Any], depth: int) -> list[str]:
    lines: list[str] = []
    for name, value in parts.items():
        if isinstance(value, Mapping):
            lines += [f"{'  ' * depth}{name}:", *_yaml(value, depth + 1)]
        else:
            text = repr(float(value))
            if "e" in text and "." not in text:
                text = text.replace("e", ".0e")
            lines.append(f"{'  ' * depth}{name}: {text}")
    return lines
