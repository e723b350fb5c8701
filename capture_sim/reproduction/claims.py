"""The table: what the paper says, what comes out here, by how much they differ, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from capture_sim.reproduction.cases import DOCKING
from capture_sim.reproduction.readings import Scan, Together
from capture_sim.reproduction.second_engine import Comparison
from capture_sim.results import first_cluster
from capture_sim.simulation import Result
from capture_sim.studies.design import Design

#: Of the paper, s (Figure 7).
FIRST_CONTACT = 0.2734


@dataclass(frozen=True)
class Claim:
    """One line of the table.

    ``agrees`` is None where the paper gives nothing to agree with, or nothing was run.
    """

    where: str
    paper: str
    here: str
    difference: str
    why: str
    agrees: bool | None


def buffer_against_clamped(runs: Mapping[str, Result]) -> list[Claim]:
    """Figure 5 against Figure 6: peak force and duration."""
    clamped, buffered = runs["paper_clamped"].summary, runs["paper_undamped"].summary
    force = clamped["first_contact_peak_force"] / buffered["first_contact_peak_force"]
    time = buffered["first_contact_duration"] / clamped["first_contact_duration"]
    return [
        Claim(
            "Fig. 5",
            "clamped probe: high, short force (a curve, no numbers in the text)",
            f"{clamped['first_contact_peak_force']:.0f} N over "
            f"{clamped['first_contact_duration'] * 1e3:.1f} ms",
            "-",
            "nothing to compare with in the text",
            None,
        ),
        Claim(
            "Fig. 5, 6",
            "the buffer considerably reduces the impact force",
            f"{buffered['first_contact_peak_force']:.0f} N: {force:.2f} times less",
            "-",
            "the buffer frees the tip's own mass; its first touch is what is left",
            force >= 2.0,
        ),
        Claim(
            "Fig. 5, 6",
            "and remarkably increases the contact time",
            f"{buffered['first_contact_duration'] * 1e3:.1f} ms: {time:.1f} times longer",
            "-",
            "vehicles on the axial spring instead of on the probe's own stiffness",
            time >= 20.0,
        ),
    ]


def undamped(runs: Mapping[str, Result], durations: Mapping[float, float]) -> list[Claim]:
    """Figures 6 and 7; ``durations`` (s) of the first contact by restitution."""
    run = runs["paper_undamped"]
    lasted = run.summary["first_contact_duration"]
    first = first_cluster(run.touches)
    later = run.touches[run.touches["start"] > first["end"].max()]
    second = later["wall"][0] != first["wall"][0] if later.size else False
    best = min(durations, key=lambda e: abs(durations[e] - FIRST_CONTACT))
    listed = ", ".join(f"{t * 1e3:.1f} ms at e = {e:g}" for e, t in durations.items())
    return [
        Claim(
            "Fig. 6, 7",
            f"first contact lasts {FIRST_CONTACT} s",
            f"{lasted:.4f} s (e = 0.5)",
            f"{lasted / FIRST_CONTACT - 1.0:+.2%}",
            f"e is not given; {listed}: nearest at e = {best:g}",
            abs(lasted / FIRST_CONTACT - 1.0) <= 0.005,
        ),
        Claim(
            "Fig. 7",
            "then the tip rebounds, and hits the cone again on its upper wall",
            f"next touch on {'the other' if second else 'the same'} wall, "
            f"{(later['start'][0] - first['end'].max()) * 1e3:.0f} ms later"
            if later.size
            else "no second hit",
            "",
            "",
            bool(second),
        ),
        _verdict(runs["paper_undamped"], "Fig. 6, 7", "not captured", captured=False, why=""),
    ]


def _verdict(run: Result, where: str, says: str, captured: bool, why: str) -> Claim:
    agrees = (run.verdict.label == "captured") == captured
    s = run.summary
    return Claim(
        where,
        f"{run.scene.name}: {says}",
        f"{run.verdict.label}; nearest {s['nearest_distance'] * 1e3:.2f} mm",
        "" if agrees else "differs",
        why,
        agrees,
    )


def designed(runs: Mapping[str, Result], design: Design) -> list[Claim]:
    """Figure 8 and the design flow."""
    assert design.scene is not None
    assert design.capturing is not None
    b = design.scene.buffer
    low, high = design.capturing
    return [
        _verdict(
            runs["paper_designed"],
            "Fig. 8",
            "captured, the distance tends to 0",
            captured=True,
            why="nearly at rest there, then drifts out slowly: in the text no latch holds the tip",
        ),
        Claim(
            "section 4",
            "strokes wished for give k_A = 500 N/m, k_T = 200 N m/rad",
            f"from the strokes of (500, 200): {b.k_A:.2f}, {b.k_T:.2f}",
            f"{b.k_A / 500.0 - 1.0:+.2%}, {b.k_T / 200.0 - 1.0:+.2%}",
            "the paper does not say which strokes it wished for; `capture-sim design`",
            abs(b.k_A / 500.0 - 1.0) <= 0.01 and abs(b.k_T / 200.0 - 1.0) <= 0.01,
        ),
        Claim(
            "section 4",
            "c_A = 13 N s/m is a proper value; more and less fail",
            f"c_A from {low:.1f} to {high:.1f} N s/m captures, less and more do not",
            "",
            "13 lies near the lower end",
            low <= 13.0 <= high,
        ),
    ]


def velocities(comparison: Comparison | None, missing: str) -> list[Claim]:
    """Figures 10 and 11."""
    says = "velocities and buffer agree with SimMechanics (curves)"
    if comparison is None:
        return [Claim("Fig. 10, 11", says, "not run", "", missing, None)]
    off, law = comparison.largest_difference(), comparison.law_effect
    vehicles = [0, 1, 2, 5, 6, 7]
    return [
        Claim(
            "Fig. 10",
            says,
            "Exudyn, to the end of the first contact: chaser and target within "
            f"{off[[0, 1, 5, 6]].max():.1e} m/s and {off[[2, 7]].max():.1e} rad/s",
            f"{off[vehicles].max():.0e}",
            "both with friction clamped at v_eps; tanh instead moves the vehicles' rates by up to "
            f"{law[[0, 1, 5, 6]].max():.0e} m/s and {law[[2, 7]].max():.0e} rad/s",
            bool(off[vehicles].max() <= 1e-5),
        ),
        Claim(
            "Fig. 11",
            says,
            f"stroke rate within {off[4]:.1e} m/s, probe within {off[3]:.1e} rad/s",
            f"{off[3:5].max():.0e}",
            "as above; the probe is the lightest part, and feels each touch most",
            bool(off[3:5].max() <= 1e-5),
        ),
    ]


def docking(runs: Mapping[str, Result]) -> list[Claim]:
    """Figure 12."""
    run = runs[DOCKING]
    touched = run.summary["first_contact_time"]
    return [
        Claim(
            "Fig. 12",
            "from 1 m away at 0.1 m/s the first impact comes after 10 s",
            f"{touched:.6f} s",
            f"{touched - 10.0:+.1e} s",
            "",
            abs(touched - 10.0) < 1e-6,
        ),
        _verdict(run, "Fig. 12", "the tip slides into the capture area", captured=True, why=""),
    ]


def cases(runs: Mapping[str, Result], scans: list[Scan], together: Together) -> list[Claim]:
    """Figure 13; why cases 2 and 3 differ."""
    radius = next(scan for scan in scans if scan.reading.field == "detector.radius")
    both = together.share("paper_designed", "paper_case_2")
    return [
        _verdict(runs["paper_case_1"], "Fig. 13", "rebounds, not captured", False, ""),
        _verdict(
            runs["paper_case_2"],
            "Fig. 13",
            "not captured: too much energy dissipated",
            False,
            f"comes nearer than the designed buffer: agrees for a radius of capture of "
            f"{radius.where('paper_case_2')} only, where the designed one is not captured either; "
            f"both right in {both:.0%} of {together.count} readings of all that is open",
        ),
        _verdict(
            runs["paper_case_3"],
            "Fig. 13",
            "captured",
            True,
            f"turns back short of BE: agrees for a radius of capture of "
            f"{radius.where('paper_case_3')}",
        ),
    ]


def experiments(runs: Mapping[str, Result]) -> list[Claim]:
    """Figures 15 to 17."""
    return [
        _verdict(
            runs[name],
            figure,
            f"relative attitude {angle}: captured",
            captured=True,
            why="masses, balls, rail and latch are chosen here, as the paper gives none",
        )
        for name, figure, angle in (
            ("tilt_0", "Fig. 15", "0 deg"),
            ("tilt_p10", "Fig. 16", "+10 deg"),
            ("tilt_m10", "Fig. 17", "-10 deg"),
        )
    ]


def contact_durations(results: Mapping[float, Result]) -> dict[float, float]:
    """Return the first contact's duration, s, by restitution."""
    return {e: float(r.summary["first_contact_duration"]) for e, r in results.items()}
