"""What a rule or a group of parameters depends on: it reads no field that it does not declare."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest

from capture_sim import SceneError, load_scene, scene_names
from capture_sim.dynamics.model import parameters
from capture_sim.dynamics.model.parameters import pack
from capture_sim.scene import launch_plan as plan
from capture_sim.scene import loading as scenes
from capture_sim.scene import paths
from capture_sim.scene.cache import CachedFunction
from capture_sim.scene.loading import check_scene
from capture_sim.scene.quantities import Checked, declared

_MODULES = (plan, scenes, parameters)
FUNCTIONS = {
    f"{module.__name__}.{name}": value
    for module in _MODULES
    for name, value in vars(module).items()
    if isinstance(value, CachedFunction) and value.__module__ == module.__name__
}
#: Parts that a scene may have beside those of the packaged ones.
PARTS = {
    "latch": "latch={radius: 0.005, stiffness: 2.0e+4, damping: 80}",
    "stops": "stops={compression: 0.1, extension: null, stiffness: 1.0e+5, damping: 0}",
    "table": "buffer={k_A: 0, k_A3: 0, preload: 0, force_table: [[0, 0], [0.01, 5], [0.02, 11]]}",
}


@functools.cache
def varied_scenes():
    """Return the packaged scenes with all combinations of parts."""
    return tuple(_varied())


def _varied():
    for name in scene_names():
        for chosen in itertools.product([False, True], repeat=len(PARTS)):
            changes = [text for text, used in zip(PARTS.values(), chosen, strict=True) if used]
            yield load_scene(name, changes)


def parts_of(part, path=""):
    """Yield the parts of a scene, each with its path."""
    yield part, path
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if dataclasses.is_dataclass(value):
            yield from parts_of(value, f"{path}.{field.name}".lstrip("."))


@pytest.fixture
def reads(monkeypatch):
    """Return a function: the paths of the fields of a scene that a function reads."""
    noted = []

    def note(self, name):
        noted.append((self, name))
        return object.__getattribute__(self, name)

    def fields_read(function, scene):
        paths = {id(part): path for part, path in parts_of(scene)}
        for part, _ in parts_of(scene):  # computed properties that are cached read nothing
            for name in part.__dict__.keys() - declared(type(part)).keys():
                del part.__dict__[name]
        with monkeypatch.context() as patch:
            patch.setattr(Checked, "__getattribute__", note, raising=False)
            noted.clear()
            function(scene)
        return {
            f"{paths[id(part)]}.{name}".lstrip(".")
            for part, name in noted
            if id(part) in paths and name in declared(type(part))
        }

    return fields_read


def is_declared(path, fields):
    """Return True if a field, or a part that contains it or that it is in, is declared."""
    return any(
        path == field or path.startswith(f"{field}.") or field.startswith(f"{path}.")
        for field in fields
    )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_remembered_function_reads_only_the_fields_that_it_declares(name, reads):
    function = FUNCTIONS[name]
    for scene in varied_scenes():
        found = reads(lambda given: function.function(given), scene)
        # functions that it calls are remembered too: their fields are its own
        assert not [path for path in found if not is_declared(path, function.fields)], scene.name


def test_packed_parameters_do_not_depend_on_the_scenes_before():
    """A scene is packed after every other one, and alone, to the same bytes."""
    rng = np.random.default_rng(1)
    every = varied_scenes()
    alone = []
    for scene in every:
        forget()
        alone.append(pack(scene, 1.0, 0.1, 0.1).tobytes())
    for k in rng.permutation(np.arange(len(every)).repeat(3)):
        assert pack(every[k], 1.0, 0.1, 0.1).tobytes() == alone[k]


def forget():
    for function in FUNCTIONS.values():
        function._last = None


#: Fields whose value alone decides about a rule, with a value that breaks it.
REFUSED = {
    "cone.R_c": 1e-4,
    "friction.mu_s": 1e-9,
    "latch.radius": 10.0,
    "rail.length": 50.0,
    "initial.chaser.x": 5.0,
    "initial.chaser.vx": 0.5,
    "initial.target.vx": 0.5,
    "run.rate": 333.0,
    "supports.chaser.balls": ((1.0, 1.0), (1.1, 1.0), (1.0, 1.1)),
    "string.drop_height": 30.0,
    "buffer.rest_length": 1e-4,
    "contact.restitution": 0.0,
}


@pytest.mark.parametrize("path", REFUSED)
def test_one_bad_value_between_good_ones_is_refused_as_alone(path):
    good = load_scene("tilt_0")
    if path == "contact.restitution":
        good = load_scene("tilt_0", ["contact.law=flores"])
    if paths.get(good, path.rpartition(".")[0]) is None:
        pytest.skip("no such part")
    bad = paths.changed(good, path, REFUSED[path])
    forget()
    with pytest.raises(SceneError) as alone:
        check_scene(bad)
    check_scene(good)
    for _ in range(2):
        with pytest.raises(SceneError) as between:
            check_scene(bad)
        assert str(between.value) == str(alone.value)
        check_scene(good)
