"""The rules of plausibility by messages as they have arrived at a node."""

import dirty

from capture_sim.messages.topics import TOPICS
from capture_sim.nodes.trials.evidence import Evidence, refusing
from capture_sim.plausibility.clocks import OF_ARRIVALS
from capture_sim.plausibility.rules import RULES
from capture_sim.scene.loading import load_scene


def test_a_late_node_blames_no_clock_after_the_verdict():
    """A busy detector took poses and buffer 1.75 s late, as if the load cell's clock were ahead."""
    scene, evidence = load_scene("tilt_p10"), Evidence(())
    topics = {topic.absolute_name: topic for topic in TOPICS}
    for record in dirty.clean():
        late = record.topic != dirty.CELL
        evidence.add(topics[record.topic], record.data, record.log_time + 1_750_000_000 * late)
    assert {doubt.rule.name for doubt in refusing(evidence.of_trial(scene))} == {"clock_offset"}
    assert refusing(evidence.of_trial(scene, OF_ARRIVALS)) == []
    assert set(OF_ARRIVALS) <= set(RULES)
