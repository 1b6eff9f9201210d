"""What the suite asks of every picture (tests/legible.py, conftest) sees what is wrong with one."""

import numpy as np
import pytest
from legible import faults as faults_of_drawn
from matplotlib.figure import Figure

from torchfovea.commands.shared.pictures import PALETTE


def faults(made):
    made.draw_without_rendering()
    return faults_of_drawn(made)


def figure(width=12.0):
    made = Figure(figsize=(width, 6), layout="constrained")
    axes = made.subplots()
    axes.set(xlabel="distance [m]", ylabel="share of errors")
    return made, axes


def test_a_good_picture_has_no_fault():
    made, axes = figure()
    axes.plot([0, 1], [0, 1], color="#0072B2", label="ours")
    axes.plot([0, 1], [1, 0], color="#D55E00", label="theirs")
    drawn = axes.scatter([0, 1], [0, 1], c=[0, 1], cmap="viridis")
    made.colorbar(drawn, label="information [nats]")
    assert faults(made) == []


def unnamed(axes):
    axes.set_xlabel("")


def unnamed_logarithm(axes):
    axes.set(yscale="log", ylim=(1e-3, 1), ylabel="")


def without_unit(axes):
    axes.set_ylabel("range")


def rainbow(axes):
    axes.imshow(np.arange(4.0).reshape(2, 2), cmap="jet")


def red_and_green(axes):
    axes.plot([0, 1], [0, 1], color="#c04000", label="one")
    axes.plot([0, 1], [1, 0], color="#707000", label="other")


def bare_bar(axes):
    axes.figure.colorbar(axes.scatter([0, 1], [0, 1], c=[0, 1], cmap="viridis"))


def tiny(axes):
    axes.set_title("tiny", fontsize=5)


def heaped(axes):
    axes.figure.set_layout_engine("none")
    axes.figure.add_axes(axes.get_position()).set(xlabel="time [s]", ylabel="gap")


@pytest.mark.parametrize(
    ("harm", "line"),
    [
        (unnamed, "x of '"),
        (unnamed_logarithm, "y of '"),
        (without_unit, "'range' has no unit"),
        (rainbow, "colours of jet"),
        (red_and_green, "apart to some eyes"),
        (bare_bar, "a colour bar of"),
        (tiny, "'tiny': 6.9 px high"),
        (heaped, "is written over"),
    ],
)
def test_a_fault_is_seen(harm, line):
    made, axes = figure()
    harm(axes)
    assert any(line in fault for fault in faults(made)), faults(made)


def test_every_eye_tells_the_palette_apart():
    made, axes = figure()
    for k, colour in enumerate(PALETTE):
        axes.plot([0, 1], [k, k], color=colour, label=str(k))
    assert faults(made) == []


def test_a_wide_picture_is_shown_small():
    assert any("px high" in fault for fault in faults(figure(width=20)[0]))


def test_axes_in_space_and_shared_axes():
    made = Figure(figsize=(12, 6), layout="constrained")
    space = made.add_subplot(2, 2, 1, projection="3d")
    space.set(xlabel="x [m]", ylabel="y [m]")
    assert [fault for fault in faults(made) if fault.startswith("z of")]
    space.set_zlabel("z [m]")
    left = made.add_subplot(2, 2, 3)
    right = made.add_subplot(2, 2, 4, sharey=left)
    for axes in (left, right):
        axes.set_xlabel("time [s]")
    left.set_ylabel("gap")
    assert faults(made) == []
