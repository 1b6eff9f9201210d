"""Noise of rendered pictures against the variance it is defined by, and that it is the seed's."""

import math

import pytest
import torch
from hydra import compose, initialize_config_dir

from torchfovea.cli import main
from torchfovea.commands.shared.build import build_arena, build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.setting import SettingError
from torchfovea.sim.noise import ImageNoise, expose
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World


@pytest.mark.parametrize(
    ("brightness", "photons", "read"), [(0.5, 1000.0, 0.0), (0.25, math.inf, 0.02), (0.4, 400.0, 0.03)]
)
def test_the_variance_is_that_of_photons_and_read_out(brightness, photons, read):
    image = torch.full((3, 200, 200), brightness)
    out = expose(image, ImageNoise(photons, read, 0.0), 1.0, torch.Generator().manual_seed(0))
    wanted = math.sqrt(brightness / photons + read**2)
    assert float(out.mean()) == pytest.approx(brightness, abs=4 * wanted / math.sqrt(out.numel()))
    assert float(out.std()) == pytest.approx(wanted, rel=0.02)
    # against a Poisson count of the photons themselves, where they are few enough to tell
    if math.isfinite(photons):
        count = torch.poisson(image.double() * photons, generator=torch.Generator().manual_seed(1)) / photons
        assert float((count.var() + read**2).sqrt()) == pytest.approx(float(out.std()), rel=0.02)


def test_pictures_stay_pictures():
    ends = torch.cat([torch.zeros(3, 50, 50), torch.ones(3, 50, 50)])
    out = expose(ends.reshape(3, 100, 50), ImageNoise(100.0, 0.05), 1.3, torch.Generator().manual_seed(0))
    assert float(out.min()) >= 0 and float(out.max()) <= 1


def test_a_repeated_gaze_is_another_picture_and_a_repeated_search_the_same():
    scene = build_scene(Cans(cans=2), 0)
    first, second = (World(scene, source_px=40, noise=ImageNoise(), seed=3) for _ in range(2))
    plain = World(scene, source_px=40)
    a, again = first.images(), first.images()
    assert not torch.equal(a[0].image, again[0].image)
    for one, other in zip((*a, *again), (*second.images(), *second.images()), strict=True):
        assert torch.equal(one.image, other.image)
    first.reset()
    assert torch.equal(first.images()[1].image, a[1].image)
    assert torch.equal(plain.images()[0].image, plain.images()[0].image)
    off = World(scene, source_px=40, noise=ImageNoise(), seed=4).images()[0].image
    assert not torch.equal(off, a[0].image)
    torch.testing.assert_close(off, plain.images()[0].image, atol=0.12, rtol=0)


def test_eyes_are_exposed_apart():
    noise = ImageNoise(math.inf, 0.0, 0.1)
    logs = [math.log(noise.gains(torch.Generator().manual_seed(k))[0] ** 2) for k in range(400)]
    assert torch.tensor(logs).std() == pytest.approx(0.1, rel=0.1)
    left, right = noise.gains(torch.Generator().manual_seed(0))
    assert left * right == pytest.approx(1.0)


def test_it_is_a_setting_on_by_default(tmp_path, capsys):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        on = compose("search", overrides=["scene=cans", "sensor.source_px=40"])
        off = compose("search", overrides=["scene=cans", "sensor.source_px=40", "noise=null"])
    assert build_arena(on, build_observer(on), 0).world.noise == ImageNoise()
    assert build_arena(off, build_observer(off), 0).world.noise is None
    for settings, named in (
        ("noise.photons=0", "noise.photons = 0"),
        ("noise.read=-1", "noise.read = -1"),
        ("noise.exposure=nan", "noise.exposure = nan"),
        ("noise=3", "noise = 3: expected a mapping or null"),
    ):
        assert main(["search", "episodes=1", "saccades=1", settings, f"hydra.run.dir={tmp_path}/run"]) == 1
        assert named in capsys.readouterr().err
    with pytest.raises(SettingError, match=r"noise.read = 2"):
        ImageNoise(read=2)
