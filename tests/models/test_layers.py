"""How layers are named, wired and refused."""

import pytest

from pyro_dynogp.models.wiring import Dynamic, Static, wire
from tests.models.cascades import MODELS


def test_names():
    def names(*layers):
        return [one.name for one in wire(1, layers)]

    assert names(Dynamic(), Static()) == ["g", "f"]
    assert names(Dynamic(), Static(), Dynamic()) == ["g1", "f", "g2"]
    assert names(Static(), Static(name="bend"), Dynamic()) == ["f1", "bend", "g"]


@pytest.mark.parametrize(("name", "sources", "channels", "pathwise"), [
    ("linear", [("inputs",)], [1], [False]),
    ("Wiener", [("inputs",), ("g",)], [1, 1], [False, False]),
    ("Hammerstein", [("inputs",), ("f",)], [1, 1], [True, False]),
    ("Wiener-Hammerstein", [("inputs",), ("g1",), ("f",)], [1, 1, 1], [True, True, False]),
    ("Hammerstein-Wiener", [("inputs",), ("f1",), ("g",)], [1, 1, 1], [True, False, False]),
    ("several channels", [("inputs",), ("g1",), ("f",)], [2, 2, 2], [True, True, False]),
    ("skips", [("inputs",), ("g1", "inputs"), ("f", "g1", "inputs")], [2, 3, 4],
     [True, True, False]),
])  # fmt: skip
def test_wires(name, sources, channels, pathwise):
    wires = MODELS[name]().wires
    assert [one.sources for one in wires] == sources
    assert [one.channels for one in wires] == channels
    assert [one.pathwise for one in wires] == pathwise
    assert [one.last for one in wires] == [False] * (len(wires) - 1) + [True]


def test_pathwise_reaches_through_static_layers():
    """What a dynamic layer sees through another static one has to be one function too."""
    chain = wire(1, (Static(), Static(), Dynamic(), Static(), Static()))
    assert [one.pathwise for one in chain] == [True, True, False, False, False]
    skipping = wire(1, (Static(), Static(), Dynamic(skip=("f1",))))
    assert [one.pathwise for one in skipping] == [True, True, False]


def test_a_first_static_layer_has_a_linear_mean_others_a_constant_one():
    means = [one.layer.mean for one in wire(1, (Static(), Dynamic(), Static()))[::2]]
    assert means == ["linear", "constant"]
    assert wire(1, (Static(mean="constant"),))[0].layer.mean == "constant"
    stops = wire(1, (Dynamic(), Static(limits=(None, 2.0))))[-1].layer
    assert (stops.mean, stops.limits) == ("linear", (None, 2.0))


@pytest.mark.parametrize(("inputs", "layers", "message"), [
    (1, (), "layers: expected at least one layer"),
    (1, ("dynamic",), "expected Dynamic, Static and Known layers, got 'dynamic'"),
    (1, (Dynamic(name="a"), Static(name="a")), "a name of its own for each layer"),
    (1, (Dynamic(name="f"), Static()), "a name of its own for each layer"),
    (1, (Dynamic(name="y"),), "none of .*'y'"),
    (1, (Dynamic(name="inputs"),), "none of .*'inputs'"),
    (1, (Dynamic(name="offset"),), "none of .*'offset'"),
    (1, (Dynamic(), Static(skip=("g2",))), r"skip of layer 'f': expected names of earlier signals"),
    (1, (Dynamic(skip=("f",)), Static()), "skip of layer 'g'.*got 'f'"),  # forward
    (1, (Dynamic(), Static(limits=(2.0, 1.0))), "limits of layer 'f': expected .* low < high"),
    (1, (Dynamic(), Static(limits=(None, None))), "limits of layer 'f': expected"),
    (1, (Dynamic(), Static(limits=(1.0,))), "limits of layer 'f': expected"),
    (1, (Static(limits=(0.0, 1.0)), Dynamic()), "limits of layer 'f'.*not the last layer"),
    (1, (Dynamic(outputs=2), Static(limits=(0.0, 1.0))), "limits of layer 'f'.*got .*2 signals"),
    (1, (Dynamic(), Static(mean="constant", limits=(0.0, 1.0))), "got mean 'constant'"),
    (1, (Dynamic(skip=("inputs",)),), "skip of layer 'g'"),  # seen already
    (1, (Dynamic(), Static(skip=("f",))), "skip of layer 'f'.*got 'f'"),  # itself
    (0, (Static(),), "expected inputs for a static layer"),
    (0, (Dynamic(process_noise=False),), "process_noise of layer 'g': expected True"),
    (1, (Dynamic(pairs=0),), "pairs of layer 'g': expected a whole number >= 1"),
    (1, (Dynamic(outputs=1.0),), "outputs of layer 'g'"),
    (1, (Dynamic(noise="white"),), "noise of layer 'g': expected 'shared' or 'independent'"),
    (1, (Static(inducing=0),), "inducing of layer 'f'"),
    (1, (Static(support=0),), "support of layer 'f'"),
    (1, (Static(mean="cubic"),), "mean of layer 'f': expected 'constant' or 'linear'"),
])  # fmt: skip
def test_refused(inputs, layers, message):
    with pytest.raises(ValueError, match=message):
        wire(inputs, layers)
