"""A pose goes through the files that CONTRIBUTING names, in their order."""

import itertools

import dirty

from capture_sim.detection.detector import CaptureDetector
from capture_sim.messages.measurements import OF_A_BENCH, DetectorInput, MeasurementReader
from capture_sim.scene.loading import load_scene
from tests.walked import check_order, files_entered, way


def test_from_a_pose_to_a_verdict():
    scene = load_scene("tilt_p10")
    topics = {topic.absolute_name: topic for topic in OF_A_BENCH}
    readers = {topic: MeasurementReader(topic) for topic in OF_A_BENCH}
    measured = DetectorInput(scene, is_simulated=False, readers=readers)
    detector = CaptureDetector(scene, is_released=False)
    records = [record for record in dirty.clean("tilt_p10") if record.topic in topics]

    def walk():
        for record in itertools.dropwhile(lambda each: each.topic == dirty.JOINTS, records):
            found = measured.read(topics[record.topic], record.data)
            if found is not None and detector.measure(*found, record.log_time):
                return

    check_order(way("From a pose to a verdict")[1:], files_entered(walk))
