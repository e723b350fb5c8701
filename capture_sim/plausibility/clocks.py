"""Rules of clocks: do all sources stamp by one clock, and does it run at the right rate?"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from capture_sim.plausibility.measured import Channel
from capture_sim.plausibility.motion import MIN_MESSAGES, MeasuredMotion
from capture_sim.plausibility.rules import Grade, Said, rule

#: An offset between the sources' clocks beyond this is reported, s.  Latencies of drivers are up to
#: about 0.03 s.
WARN_OFFSET = 0.05
#: An offset beyond this refuses the run, s: at 0.1 m/s it moves the tip by 20 mm.
MAX_OFFSET = 0.2
#: Contacts that sources see further apart than this are doubted, s.
_CONTACT_OFFSET = 0.08
#: A clock is doubted if its rate differs by more than the first number, and if this makes an
#: offset of more than the second number, s, in the recording.
_DRIFT, _DRIFTED = 2e-4, 2e-3
#: Blocks of a recording for the drift of a clock.
_BLOCKS = 10
#: Stamps by a clock that runs as arrivals do advance by this much in a second of arrivals.
_LIVE_RATES = (0.8, 1.25)
#: A bench's stamps may advance at another rate, as tests and paced replays have it: beyond this
#: rate arrivals say nothing.
_MAX_RATE = 10.0
#: Least number of messages on either side of a step of a clock, and the time by arrival from which
#: they are taken on either side, s: longer than transports hold messages back.
_N_STEPPED, _STEP_WINDOW = 7, 5.0
#: The message with this rank counts as the fastest on either side of a step: those with the ranks
#: before it may have wild stamps.
_FASTEST = 3
#: Share of repeated stamps above which they are noted, and above which the run is refused.
_REPEATS_REPORTED, _REPEATS_REJECTED = 0.02, 0.5
#: A clock that counts from the boot of a machine is below this, s; a wall clock is above.
_BOOT = 3e8


class _Clock(NamedTuple):
    """The clock by which a source stamps its messages."""

    channel: Channel
    offset: float  # s, stamp less arrival of the fastest messages, or ahead of another source
    stamp: float  # s, of the first message, in that clock


def _rate_of(channel: Channel) -> float:
    """Return by how much a source's stamps advance in a second of arrivals; 0 if not known.

    It is the median over pairs of messages a quarter of the recording apart, so that a single step
    of the clock has little influence.
    """
    lag = max(channel.count // 4, 1)
    passed = channel.t[lag:] - channel.t[:-lag]
    waited = channel.arrival[lag:] - channel.arrival[:-lag]
    is_apart = waited > 0.0
    return float(np.median(passed[is_apart] / waited[is_apart])) if is_apart.any() else 0.0


def _timed(motion: MeasuredMotion) -> list[tuple[Channel, float]]:
    """Return the sources whose clocks can be compared, each with its rate by :func:`_rate_of`.

    A source needs ``MIN_MESSAGES`` messages with known arrivals, and at most half of its stamps may
    be 0.
    """
    return [
        (channel, motion.once(f"rate {channel.topic}", partial(_rate_of, channel)))
        for channel in motion.measured.channels
        if channel.count >= MIN_MESSAGES and channel.arrival.size and not _is_unset(motion, channel)
    ]


def _clocks(motion: MeasuredMotion) -> list[_Clock]:
    """Return the clocks that run at about the rate of arrivals, see ``_LIVE_RATES``."""
    found = []
    for channel, rate in _timed(motion):
        if _LIVE_RATES[0] <= rate <= _LIVE_RATES[1]:
            offset = float(np.percentile(channel.t - channel.arrival, 99.0))
            first = float(channel.t[0]) + motion.measured.origin / 1e9
            found.append(_Clock(channel, offset, first))
    return found


def _offsets(motion: MeasuredMotion) -> Iterator[tuple[_Clock, float]]:
    """Yield each clock with its offset from the reference, s, positive if it is ahead.

    The reference is the clock with which most other clocks agree.  If several have as many, it is
    the one nearest to arrivals.  If fewer than two clocks run at about the rate of arrivals, the
    offsets are those of :func:`_offsets_at_a_rate`.
    """
    clocks = _clocks(motion)
    if len(clocks) < 2:
        yield from _offsets_at_a_rate(motion)
        return

    def rank(clock: _Clock) -> tuple[int, float]:
        like = sum(abs(other.offset - clock.offset) <= MAX_OFFSET for other in clocks)
        return -like, abs(clock.offset)

    reference = min(clocks, key=rank)
    for clock in clocks:
        yield clock, clock.offset - reference.offset


def _offsets_at_a_rate(motion: MeasuredMotion) -> Iterator[tuple[_Clock, float]]:
    """Yield the clocks of a bench that runs faster or slower than arrivals, with their offsets, s.

    Such a bench is e.g. a recording that is replayed at another speed.  Stamp less arrival then
    grows with time, so that the latest stamps of two sources are compared at the same moment, see
    :func:`_lead`.  Clocks whose rate differs from the common one are left out.
    """
    timed = [(c, rate) for c, rate in _timed(motion) if 1.0 / _MAX_RATE <= rate <= _MAX_RATE]
    if len(timed) < 2:
        return
    common = float(np.median([rate for _, rate in timed]))
    channels = [c for c, rate in timed if _LIVE_RATES[0] <= rate / common <= _LIVE_RATES[1]]
    leads = {(a, b): _lead(a, b) for a in channels for b in channels if a is not b}

    def rank(channel: Channel) -> int:
        return -sum(
            abs(leads[other, channel]) <= MAX_OFFSET for other in channels if other is not channel
        )

    if len(channels) < 2:
        return
    reference = min(channels, key=rank)
    for channel in channels:
        lead = 0.0 if channel is reference else leads[channel, reference]
        first = float(channel.t[0]) + motion.measured.origin / 1e9
        yield _Clock(channel, lead, first), lead


def _lead(channel: Channel, other: Channel) -> float:
    """Return by how much the stamps of ``channel`` are ahead of those of ``other``, s.

    It is the median difference between a message's stamp and the latest stamp of ``other`` at its
    arrival.  Its size is reduced by the scatter of the differences, to 0 at least, because messages
    may arrive in batches.  0 also if too few messages can be compared.
    """
    order, arrival = np.argsort(channel.arrival, kind="stable"), np.sort(channel.arrival)
    latest = np.searchsorted(np.sort(other.arrival), arrival, side="right") - 1
    stamps = other.t[np.argsort(other.arrival, kind="stable")]
    inside = (latest >= 0) & (arrival <= other.arrival.max())
    if inside.sum() < MIN_MESSAGES:
        return 0.0
    low, lead, high = np.percentile(channel.t[order][inside] - stamps[latest[inside]], [10, 50, 90])
    return float(np.sign(lead) * max(abs(lead) - (high - low), 0.0))


#: Rules that compare stamps with arrivals, which a busy node delays.
OF_ARRIVALS = ("clock_offset", "clock_steps", "clock_drifts")


@rule(
    "clock_offset",
    Grade.REFUSED,
    compares="stamp less arrival of a source's fastest messages with those of the other sources",
    threshold=f"> {WARN_OFFSET} s: noted; > {MAX_OFFSET} s: refused",
    reason="latencies of drivers are up to 0.03 s; at 0.1 m/s, 0.2 s move the tip by 20 mm, four "
    "capture radii",
)
def clock_offset(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source whose clock, or whose latency, differs from the others."""
    for clock, offset in _offsets(motion):
        if abs(offset) <= WARN_OFFSET:
            continue
        is_far = abs(offset) > MAX_OFFSET
        cause = "synchronise the drivers' clocks (chrony, PTP)"
        if clock.stamp < _BOOT < clock.stamp - offset:
            cause = "the stamps look like a steady clock's since boot: stamp with ROS time"
        elif offset < 0.0 and not is_far:
            cause = "a clock behind, or a source that takes so long to arrive, which is harmless"
        yield Said(
            clock.channel.topic,
            f"stamps {abs(offset):.6g} s {'ahead of' if offset > 0 else 'behind'} those of the "
            f"other sources: must be within {MAX_OFFSET if is_far else WARN_OFFSET} s; {cause}",
            grade=None if is_far else Grade.NOTED,
        )


@rule(
    "clock_steps",
    Grade.REFUSED,
    compares="stamp less arrival of the fastest messages in the "
    f"{_STEP_WINDOW:g} s after a jump of the stamps with those before",
    threshold=f"> {MAX_OFFSET} s",
    reason="as clocks_apart; late or lost messages make no step, and of one wild stamp the next "
    "ones know nothing",
)
def clock_steps(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source whose clock was set to another time in the recording."""
    for channel, rate in _timed(motion):
        step, other = _step(channel, rate), _rate_between_ends(channel)
        if step != 0.0 and not _LIVE_RATES[0] <= other / rate <= _LIVE_RATES[1]:
            # long pauses of a transport spoil one estimate of the rate, and long steps the other
            step = step if step * _step(channel, other) > 0.0 else 0.0
        if step != 0.0:
            yield Said(
                channel.topic,
                f"clock stepped by {step:+.3g} s: must be within {MAX_OFFSET} s; keep the driver's "
                "clock from being set (chrony with slewing, PTP)",
            )


def _rate_between_ends(channel: Channel) -> float:
    waited = float(channel.arrival.max() - channel.arrival.min())
    return float(channel.t.max() - channel.t.min()) / waited if waited > 0.0 else 0.0


def _step(channel: Channel, rate: float) -> float:
    """Return the first step of a source's clock, s, positive if it was set forwards; 0 if none.

    ``rate`` is by how much the stamps advance in a second of arrivals.  Steps of up to
    ``MAX_OFFSET`` are ignored.
    """
    advance = np.diff(channel.t)
    jump = advance - rate * np.diff(channel.arrival)
    jumped = (jump > MAX_OFFSET) | ((jump < -MAX_OFFSET) & (advance < 0.0))
    offset, arrival = channel.t - rate * channel.arrival, channel.arrival
    index = np.arange(channel.count)
    for k in np.flatnonzero(jumped) + 1:
        before = (index < k) & (arrival >= arrival[k - 1] - _STEP_WINDOW)
        after = (index >= k) & (arrival <= arrival[k] + _STEP_WINDOW)
        if not all(_runs(channel, side, rate) for side in (before, after)):
            continue
        # what was held back and comes at once, or overtakes, is slow: the fastest are as before
        step = float(np.sort(offset[after])[-_FASTEST] - np.sort(offset[before])[-_FASTEST])
        if abs(step) > MAX_OFFSET and step * jump[k - 1] > 0.0:
            return step
    return 0.0


def _runs(channel: Channel, side: np.ndarray, rate: float) -> bool:
    """Return True if the messages of one side of a step show the clock's offset.

    ``side`` (n,) bool marks them.  There must be enough of them, and they must not have arrived in
    much less time than their stamps span, as messages do that were held back.
    """
    if side.sum() < _N_STEPPED:
        return False
    stamped, waited = np.ptp(channel.t[side]), np.ptp(channel.arrival[side])
    return bool(rate * waited > 0.5 * stamped)


@rule(
    "clock_drifts",
    Grade.NOTED,
    compares="rate of a source's stamps with that of another source's, both by arrivals",
    threshold="> 200 ppm that make > 2 ms in the recording, 5 times the scatter",
    reason="quartz clocks differ by less than 100 ppm; 2 ms are 0.2 mm at 0.1 m/s",
)
def clock_drifts(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source whose clock runs faster or slower than the others.

    The reference is the rate with which most others agree; if several have as many, the one
    nearest to arrivals.
    """
    lines = {clock.channel.topic: _rate(clock.channel) for clock in _clocks(motion)}
    if len(lines) < 2:
        return
    rates = [rate for rate, _, _ in lines.values()]
    reference = min(rates, key=lambda x: (-sum(abs(y - x) <= _DRIFT for y in rates), abs(x)))
    for topic, (rate, scatter, duration) in lines.items():
        drift = rate - reference
        if abs(drift) > _DRIFT and abs(drift) * duration > max(_DRIFTED, 5.0 * scatter):
            yield Said(
                topic,
                f"clock runs {1e6 * abs(drift):.3g} ppm {'fast' if drift > 0 else 'slow'}, "
                f"{1e3 * abs(drift) * duration:.3g} ms in {duration:.3g} s: must be within 200 ppm "
                "of the other sources; synchronise the clocks",
            )


def _rate(channel: Channel) -> tuple[float, float, float]:
    """Return a clock's rate by arrivals less 1, its scatter (s), and the recording's duration (s).

    The rate is the slope of a line through stamp less arrival of the fastest message in each tenth
    of the recording.  The scatter is the largest distance from that line.  If too few tenths have
    messages, the rate is 0 and the scatter infinite.
    """
    duration = float(channel.arrival.max() - channel.arrival.min())
    offset = channel.t - channel.arrival
    edges = np.linspace(channel.arrival.min(), channel.arrival.max(), _BLOCKS + 1)
    block = np.clip(np.searchsorted(edges, channel.arrival, side="right") - 1, 0, _BLOCKS - 1)
    used = [k for k in range(_BLOCKS) if (block == k).sum() >= 3]
    if len(used) < 5 or duration <= 0.0:
        return 0.0, np.inf, duration
    # the fastest message of each block: others were late
    best = [int(np.flatnonzero(block == k)[np.argmax(offset[block == k])]) for k in used]
    t, values = channel.arrival[best], offset[best]
    rate, middle = np.polyfit(t - t.mean(), values, 1)
    scatter = float(np.abs(values - middle - rate * (t - t.mean())).max())
    return float(rate), scatter, duration


def _is_unset(motion: MeasuredMotion, channel: Channel) -> bool:
    return float(_unset(motion, channel).mean()) > _REPEATS_REJECTED


def _unset(motion: MeasuredMotion, channel: Channel) -> np.ndarray:
    """Return True for each stamp that is 0 to within 1 ms, (n,) bool."""
    return np.asarray(np.abs(channel.t + motion.measured.origin / 1e9) < 1e-3)


@rule(
    "stamps_unset",
    Grade.REFUSED,
    compares="header.stamp with 0",
    threshold="stamps that are 0 are left out; refused if more than half of a source's are",
    reason="0 means 'not set' in ROS: the times of the measurements are unknown",
)
def stamps_unset(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source of whose stamps some are 0."""
    for channel in motion.measured.channels:
        number = int(_unset(motion, channel).sum())
        text = f"{number} of {channel.count} stamps are 0: have the driver set header.stamp"
        if _is_unset(motion, channel):
            yield Said(channel.topic, text)
        elif number:
            yield Said(channel.topic, text, number, grade=Grade.LEFT_OUT)


def _repeated(channel: Channel) -> float:
    """Return the share of messages that repeat a stamp with other values; 0 if n is too small.

    The messages are compared with those before them in the order of stamps.
    """
    if channel.count < MIN_MESSAGES:
        return 0.0
    order = np.argsort(channel.t, kind="stable")
    t, values = channel.t[order], channel.values[order]
    same = (np.diff(t) == 0.0) & (np.diff(values, axis=0) != 0.0).any(axis=1)
    return float(same.mean())


@rule(
    "stamps_repeat",
    Grade.REFUSED,
    compares="stamps of successive messages whose values differ",
    threshold=f"more than {_REPEATS_REPORTED:.0%} repeat an earlier stamp: noted; more than "
    f"{_REPEATS_REJECTED:.0%}: refused",
    reason="single ones occur where two messages are stamped in one tick",
)
def stamps_repeat(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source of whose stamps many repeat an earlier one."""
    for channel in motion.measured.channels:
        share = _repeated(channel)
        if share <= _REPEATS_REPORTED or _is_unset(motion, channel):
            continue
        text = f"{100 * share:.3g} % of the stamps repeat an earlier one: "
        if share > _REPEATS_REJECTED:
            yield Said(channel.topic, f"{text}must be the time of each measurement")
        else:
            yield Said(
                channel.topic,
                f"{text}of equal stamps the first message counts; check for two publishers",
                grade=Grade.NOTED,
            )


@rule(
    "contact_times",
    Grade.NOTED,
    compares="first contact as seen by buffer and force with the time in which poses allow it",
    threshold=f"outside by > {_CONTACT_OFFSET} s; or force later than buffer by more",
    reason="0.05 s of clocks, and 3 mm of the base frames at 0.1 m/s; poses allow a contact from "
    "when the tip is near a wall until it would be inside",
    needs=("scene", "poses"),
)
def contact_times(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield one finding if the sources show the first contact at different times.

    Buffer and force are each compared with the time in which poses allow a contact.  If both agree
    with it, or if there is no such time, a force that begins later than the buffer is reported.  A
    force that begins earlier is not: a stiff buffer need not yield to the first touch.
    """
    seen = motion.contacts
    first, last = motion.near_time, seen.get("poses")
    for name in ("buffer", "force"):
        if name not in seen:
            continue
        late = 0.0
        if first is not None and motion.is_tracked(seen[name] - _CONTACT_OFFSET, first):
            late = min(seen[name] - first, 0.0)
        source = motion.buffer if name == "buffer" else motion.force
        # a source with a gap there shows the contact when it comes back
        if last is not None and motion.is_tracked(last, last + _CONTACT_OFFSET, source):
            late = late or max(seen[name] - last, 0.0)
        if name == "force" and late > 0.0 and not motion.is_force_clear:
            continue
        if abs(late) > _CONTACT_OFFSET:
            yield Said(
                motion.topic_of(name),
                f"shows the first contact {abs(late):.3g} s {'later' if late > 0 else 'earlier'} "
                f"than poses allow: must be within {_CONTACT_OFFSET} s; check clocks and base "
                "frames",
            )
            return
    if "buffer" in seen and "force" in seen:
        late = seen["force"] - seen["buffer"]
        # a stiff buffer need not yield to the first touch
        if late > _CONTACT_OFFSET and motion.is_force_clear:
            yield Said(
                motion.topic_of("force"),
                f"shows the first contact {late:.3g} s later than the buffer: must be within "
                f"{_CONTACT_OFFSET} s; check the clocks",
            )
