"""Pictures are drawn in forked processes, which must leave alone what they have inherited."""

import gc
import os

from capture_sim import simulate
from capture_sim.commands import output


class NeedsItsProcess:
    """As an object of DDS: its destructor crashes in a process that was forked."""

    def __init__(self):
        self.process, self.cycle = os.getpid(), self

    def __del__(self):
        if os.getpid() != self.process:
            os.abort()


def collect_and_write(_draw, _runs, _labels, path):
    gc.collect()
    path.write_text("drawn")
    return path


def test_what_a_process_has_inherited_is_not_collected_in_it(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(output, "_save_picture", collect_and_write)
    monkeypatch.setattr(output, "_save_rrd", save_nothing)
    run = simulate("tilt_0", t_end=0.1)
    gc.disable()
    try:
        NeedsItsProcess()  # garbage by its cycle alone
        output.draw([run], ["tilt_0"], tmp_path)
    finally:
        gc.enable()
        gc.collect()
    assert (tmp_path / "tilt_0.png").read_text() == "drawn"
    assert "plot in" in capfd.readouterr().out


def save_nothing(_runs, path, _labels, _window):
    return path
