"""Corners that the mutation check (scripts/mutants.py) found no other test to stand in."""

import math

import pytest
import torch

import torchfovea as tf
from torchfovea import metrics
from torchfovea.deciding import reward
from torchfovea.gaussian import (
    Gaussian,
    Information,
    columns,
    gaussian_from_information,
    pack,
    positive_definite,
    quadratic3,
    rotate3,
    unpack,
)
from torchfovea.memory.egosphere import (
    Fusion,
    Prior,
    cartesian_from_patches,
    empty_memory,
    inverse_range_belief,
    prior_information,
    reducible,
    trust,
)
from torchfovea.memory.pooling import Pooled, add_common, found_points, nearness, pool, pool_patches, share_errors
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.update import remember
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import Gaze, Head, eyes
from torchfovea.sensing.kinship import Kinship
from torchfovea.sensing.triangulation import Observations, observe, triangulate_rectified
from torchfovea.sensing.unscented import SigmaPoints, sigma_root
from torchfovea.setting import SettingError

CELLS = fibonacci_directions(12, torch.float64)


def test_one_bad_direction_among_good_ones_is_refused():
    for length in (0.9, 1.1):
        cells = CELLS.clone()
        cells[3] *= length
        with pytest.raises(SettingError, match="cells = directions: expected finite unit vectors"):
            empty_memory(cells, Prior())


def test_whole_numbers_are_no_directions_of_cells():
    """Unit vectors along the axes pass for directions; found by scripts/fuzz.sh in `resample`."""
    axes = torch.eye(3, dtype=torch.int64)
    with pytest.raises(SettingError, match=r"cells.dtype = torch.int64: expected torch.float32 or torch.float64"):
        empty_memory(axes, Prior())
    with pytest.raises(SettingError, match=r"cells.dtype"):
        tf.resample(empty_memory(CELLS, Prior()), axes, Fusion())


def test_what_is_at_the_limit_of_a_setting_is_taken():
    assert Fusion(gate_deg=0, gate_spacing=0).gate_deg == 0
    assert Fusion(conflict=0.5).votes and Fusion(nearest_m=0.05).nearest_m == 0.05 and Fusion(half_life=0.5)
    assert Fusion(window=1.0).window == 1 and Prior(std=1e9, mean=1e-9).std == 1e9
    for wrong in ({"std": 1.5e9}, {"mean": 9e-10}):
        with pytest.raises(SettingError, match="1e-9 to 1e9"):
            Prior(**wrong)
    with pytest.raises(SettingError, match=r"fusion.gate_deg = 1500000"):
        Fusion(gate_deg=1.5e6)


def test_patches_lie_within_a_kilometre():
    memory = empty_memory(CELLS, Prior())
    zero = torch.zeros(12, dtype=torch.float64)
    for rho in (zero, zero - 0.3, zero + 1e-4):
        assert torch.allclose(cartesian_from_patches(rho, zero + 1e-6, memory).mean.norm(dim=-1), zero + 1000)


def test_what_looks_may_take_away_is_what_they_average():
    """Of (Λ − q + a²)/Λ², with a and q the sums over looks of √l/u and l/u², the part (Λ − q)/Λ²."""
    generator = torch.Generator().manual_seed(0)
    looks = torch.rand(12, 5, generator=generator, dtype=torch.float64) * 1e-3 + 1e-4  # variances u
    lasts = looks * torch.rand(12, 5, generator=generator, dtype=torch.float64)  # and what of them lasts, l
    total, once, twice = (1 / looks).sum(-1), (lasts.sqrt() / looks).sum(-1), (lasts / looks**2).sum(-1)
    memory, zero = empty_memory(CELLS, Prior()), torch.zeros(12, dtype=torch.float64)
    matrix = columns(zero + 1, zero, zero, zero + 1, zero, total)
    memory = memory._replace(information=Information(memory.information.vector, matrix), lasting=columns(once, twice))
    variance = inverse_range_belief(memory)[1]
    assert torch.allclose(variance, (total - twice + once**2) / total**2)
    assert torch.allclose(reducible(memory, variance), (total - twice) / (total - twice + once**2))


def test_points_that_were_seen_are_trusted():
    """Nobody votes against them: every observation of a Cartesian memory is believed."""
    memory = empty_memory(CELLS, Prior(), "cartesian")
    seen = CELLS[[2, 7]]
    cov = torch.tensor([1e-4, 0, 0, 1e-4, 0, 1e-4], dtype=torch.float64).expand(2, 6)
    support = torch.full((2,), 1e-3, dtype=torch.float64)
    one = Observations(0.5 * seen, cov, seen, support, torch.tensor([True, True]), None, "cartesian")
    for _ in range(2):
        memory = remember(memory, one, Fusion("aligned"))
    expected = torch.zeros(12, dtype=torch.float64)
    expected[[2, 7]] = 1
    assert torch.equal(trust(memory), expected) and torch.equal(memory.votes[..., 0], 2 * expected)
    assert torch.equal(memory.votes[..., 1], 0 * expected)


def test_what_is_not_valid_is_of_unit_size():
    """So that whoever forgets the mask divides by no zero; and supports are those of all fields of a batch."""
    observer = tf.Observer(retina=tf.LogPolar(60))
    px = observer.retina.centers_px().expand(2, 60, 2)
    sigma = torch.full((2, 60), 0.3)
    valid = torch.arange(60).expand(2, 60) % 3 > 0
    gaze = tf.Gaze(*(torch.tensor(v).expand(2) for v in (0.0, 0.1, 0.2)))
    matches = tf.Correspondences(px, px - torch.tensor([4.0, 0.0]), sigma, sigma, valid)
    for chart in ("inverse_range", "cartesian"):
        seen = tf.observe(matches, tf.eyes(observer.head, gaze), observer.camera, torch.ones(60), chart=chart)
        gone = ~seen.valid
        unit = torch.tensor([1.0, 0, 0, 1, 0, 1])
        assert bool(gone.any()) and bool((seen.mean[gone] == 1).all()) and bool((seen.cov[gone] == unit).all())
        assert seen.support_rad.shape == (2, 60)


def test_rays_that_look_back_give_finite_points():
    ahead, back = torch.tensor([0.1, 0.2, 1.0]), torch.tensor([0.1, 0.2, -1.0])
    for left, right in ((ahead, back), (back, ahead), (back, back)):
        point, weight, seen = triangulate_rectified(left, right, torch.tensor(0.1))
        assert not bool(seen) and bool(torch.isfinite(point / weight).all())


def test_supports_are_angles_for_every_camera():
    """Half a field's width over the length of the ray of that focal length."""
    px, sigma = torch.tensor([[0.0, 0], [40, 10], [-30, 60]]), torch.full((3,), 0.3)
    matches = tf.Correspondences(px, px - torch.tensor([4.0, 0.0]), sigma, sigma, sigma > 0)
    gaze, width = tf.Gaze(*(torch.tensor(v) for v in (0.0, 0.1, 0.2))), torch.tensor([1.0, 2.0, 3.0])
    for camera in (tf.Pinhole(50.0), tf.Fisheye(50.0)):
        seen = tf.observe(matches, tf.eyes(tf.Head(), gaze), camera, width)
        assert torch.allclose(seen.support_rad, width / 50.0 / camera.rays(px).norm(dim=-1))


def test_the_short_way_of_pinholes_keeps_nothing_that_looks_back():
    """Where noise of one eye turns a ray back, that ray decides, not the other's; beside the way point by point."""
    plain, lens = tf.Pinhole(20.0), tf.BrownConrady(20.0, 20.0, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0))
    u = torch.linspace(-120, 120, 49)
    px = torch.stack([u, 0 * u], -1)
    gaze = tf.Gaze(*(torch.tensor(v) for v in (0.2, 0.0, 0.5)))
    kept = 0
    for left, right in ((30.0, 0.1), (0.1, 30.0)):
        sigmas = torch.full_like(u, left), torch.full_like(u, right)
        for other in (px, px.flip(0)):
            matches = tf.Correspondences(px, other, *sigmas, u == u)
            for rotated in (True, False):
                seen, expected = (
                    tf.observe(matches, tf.eyes(tf.Head(), gaze), camera, torch.ones(49), rotated=rotated)
                    for camera in (plain, lens)
                )
                assert not bool((seen.valid & ~expected.valid).any())
                kept += int(seen.valid.sum())
    assert kept > 20


def test_a_class_that_is_sought_scales_the_reward():
    """Against draws of the share and of the surface, which are independent."""
    generator = torch.Generator().manual_seed(0)
    share, spread, mean, std = 0.3, 0.1, 2.0, 0.5
    drawn = torch.randn(2, 2_000_000, generator=generator, dtype=torch.float64)
    product = (share + spread * drawn[0]) * (mean + std * drawn[1])
    number = [torch.tensor(v, dtype=torch.float64) for v in (mean, std, share, spread**2)]
    found = reward.of_class(reward.RewardBelief(*number[:2]), *number[2:])
    assert found.mean.item() == pytest.approx(product.mean().item(), abs=1e-3)
    assert found.std.item() == pytest.approx(product.std().item(), abs=1e-3)


def test_metrics_at_their_limits():
    """Exact numbers, so that a limit that belongs to the other side would show."""
    number = torch.tensor
    assert metrics.phantom(number([0.5, 0.5]), number([1.0, math.inf]), 1.0).tolist() == [False, True]
    points, target = torch.tensor([[0.5, 0, 0], [0.25, 0, 0]]), torch.zeros(3)
    assert metrics.near_target(points, target, 0.5).tolist() == [False, True]
    assert metrics.nees_mean(number([2.0])).item() == 4 and metrics.outlier_share(number([2.0])).item() == 0
    with pytest.raises(SettingError, match="covariance yy = -3"):
        metrics.information(number([[1.0, 0, 0, 2, 0, 1], [1.0, 0, 0, -3, 0, 1]]))
    # singular: the second pivot is what float32 could not resolve of a diagonal entry of 9
    flat = number([4.0, 6, 0, 9, 0, 1])
    expected = -math.log(4 * 9 * torch.finfo(torch.float32).eps)
    assert metrics.information(flat).item() == pytest.approx(expected, rel=1e-6)
    assert bool(torch.isfinite(reward.range_reward(Gaussian(torch.zeros(3), flat)).std))
    quartile = torch.special.ndtri(torch.tensor([0.75], dtype=torch.float64))
    assert metrics.coverage(quartile, (0.5,)).item() == 1


def test_what_is_said_of_far_and_empty():
    """The range that infinity counts as, a cell without any information, a Cartesian memory's bearing."""
    zero = torch.zeros(1, dtype=torch.float64)
    assert reward.range_from_inverse_range(reward.RewardBelief(zero, zero)).mean.item() == -1000
    assert reward.inverse_range_from_range(reward.RewardBelief(zero, zero)).mean.item() == 100
    nothing = Information(torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 6, dtype=torch.float64))
    rho, variance = nearness(nothing, 0.5, 4.0)
    assert rho.item() == 0 and variance.item() == 0.25
    assert not bool(empty_memory(CELLS, Prior(), "cartesian").bearing.any())
    none = torch.zeros(12, dtype=torch.float64)
    blank = Pooled(Information(none[:, None].expand(12, 3), none[:, None].expand(12, 6)), none, none)
    for chart in ("inverse_range", "cartesian"):
        assert torch.allclose(found_points(blank, CELLS, chart, 1.5), CELLS)


def test_a_flat_mixture_is_refused():
    """Its density would be infinite on a circle."""
    flat = torch.diag(torch.tensor([1.0, 1.0, 0.0]))
    with pytest.raises(SettingError, match=r"means = \(0, 3\)"):
        tf.direction_mixture([], torch.zeros(0, 3), torch.zeros(0, 3, 3))
    for given in ({"cholesky": flat[None]}, {"covariances": flat[None]}):
        with pytest.raises(SettingError, match="positive d"):
            tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], **given)


def test_evidence_of_class_enters_a_memory_that_asks_for_it():
    seen = CELLS[[2, 7]]
    one = Observations(
        torch.tensor([[0.0, 0, 2], [0, 0, 3]], dtype=torch.float64),
        torch.tensor([1e-4, 0, 0, 1e-4, 0, 1e-2], dtype=torch.float64).expand(2, 6),
        seen,
        torch.full((2,), 1e-3, dtype=torch.float64),
        torch.tensor([True, True]),
    )
    evidence = torch.tensor([[0.1, 0.9], [0.9, 0.1]], dtype=torch.float64)
    blind = empty_memory(CELLS, Prior())
    asking = blind._replace(classes=torch.full((12, 2), 0.1, dtype=torch.float64))
    assert remember(blind, one, Fusion(), evidence=evidence).classes is None
    assert torch.equal(remember(asking, one, Fusion()).classes, asking.classes)
    shares = remember(asking, one, Fusion(), evidence=evidence).classes
    shares = shares[:, 1] / shares.sum(-1)
    # prior mean plus one observation's weight, of a concentration of 0.2: (0.1 + 0.9)/(0.2 + 1)
    expected = torch.full((12,), 0.5, dtype=torch.float64)
    expected[[2, 7]] = torch.tensor([1.0, 0.2], dtype=torch.float64) / 1.2
    assert torch.allclose(shares, expected)


def test_directions_of_any_length_have_a_density():
    mixture = tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], [[0.1, 0.2, 0.3]], dtype=torch.float64)
    for length in (1e-200, 1e-100, 1e100, 1e200):
        assert torch.allclose(tf.log_density(mixture, length * CELLS), tf.log_density(mixture, CELLS))


def test_of_one_look_what_lasts_is_known_twice():
    """√l/u and l/u² of a single look: the second is the square of the first."""
    seen = CELLS[[2, 7]]
    cov = torch.tensor([1e-4, 0, 0, 1e-4, 0, 4e-4], dtype=torch.float64).expand(2, 6)
    mean = torch.tensor([[0.0, 0, 2], [0, 0, 3]], dtype=torch.float64)
    valid = torch.tensor([True, True])
    one = Observations(mean, cov, seen, torch.full((2,), 1e-3, dtype=torch.float64), valid)
    patch = torch.full((2,), 0.04, dtype=torch.float64)
    memory = remember(empty_memory(CELLS, Prior()), one, Fusion(), kin=Kinship(patch, 0.5, 0 * patch + 0.3))
    once, twice = memory.lasting.unbind(-1)
    variance = 4e-4 + 1.5**2 * 2e-4  # an error of bearing on a slope is one of inverse range
    assert once[[2, 7]].tolist() == pytest.approx([(0.3 / 1.04 / variance) ** 0.5] * 2)
    assert memory.bearing[[2, 7]].tolist() == pytest.approx([0.1**-2 + 1e4] * 2)
    assert bool((once[[2, 7]] > 0).all()) and torch.allclose(twice, once.square()) and int((once > 0).sum()) == 2


def test_points_at_one_standard_deviation_are_far_enough_out():
    assert SigmaPoints(4, 1.0, 0.0, -3.0).by_axis and SigmaPoints(4, 1.0, 0.0, -3.0).spread == 1


def test_what_an_unseen_cell_believes():
    """The prior's own numbers, each by itself."""
    prior = Prior(0.7, 0.3, 0.2, 1.1)
    information, bearing = prior_information(CELLS, prior)
    expected = torch.tensor([1.1**-2, 0, 0, 1.1**-2, 0, 0.3**-2], dtype=torch.float64)
    assert torch.allclose(information.matrix.double(), expected)
    assert torch.allclose(information.vector.double(), torch.tensor([0, 0, 0.7 / 0.09], dtype=torch.float64))
    assert torch.allclose(bearing.double(), torch.tensor(25.0, dtype=torch.float64))
    information, bearing = prior_information(CELLS, prior, "cartesian")
    assert torch.allclose(information.vector.double(), 0.7 / 0.09 * CELLS) and not bool(bearing.any())


def test_errors_in_common_of_looks_that_tell_little():
    """(1 − c)/Λ + c s²/Λ² with Λ below 1, of fields that see a cell straight ahead."""
    number = torch.tensor([1.0], dtype=torch.float64)
    total, root, patches, shared = 0.5 * number, 0.9 * number, 2.0 * number, 0.6
    matrix = columns(0 * number, 0 * number, 0 * number, 0 * number, 0 * number, total)
    pooled = Pooled(Information(columns(0 * number, 0 * number, 0.3 * total), matrix), number, 2 * number)
    found, lasting = share_errors(pooled, columns(total, root, 0.4 * number), patches, shared)
    c = shared / 3
    assert 1 / found.information.matrix[0, 5].item() == pytest.approx((1 - c) / 0.5 + c * 0.9**2 / 0.5**2)
    assert lasting.item() == pytest.approx((0.4 / 0.5) ** 2 / 3)


def test_rays_that_meet_behind_one_eye():
    left, right = torch.tensor([-0.1, 0.0, 0.0]), torch.tensor([0.1, 0.0, 0.0])
    place = torch.tensor([0.3, 0.0, 0.4])
    for sign_left, sign_right in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        _, seen = tf.triangulate(sign_left * (place - left), sign_right * (place - right), left, right)
        assert bool(seen) == (sign_left > 0 < sign_right)


def test_small_covariances_are_as_symmetric_as_large_ones():
    for size in (1e-4, 1.0, 1e4):
        cov = size * (torch.eye(3, dtype=torch.float64) + 0.1)
        tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], cov[None])
        cov[0, 1] *= 1.01
        with pytest.raises(SettingError, match="symmetric positive definite"):
            tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], cov[None])
    mean = torch.tensor([[1.0, 0.0, 0.0]])
    assert tf.direction_mixture([1.0], mean, [[0.1, 0.2, 0.3]], dtype=torch.float64).means.dtype == torch.float64


def test_roots_are_rotated_unless_told_otherwise():
    left, right = torch.tensor([0.3, 0.5]), torch.tensor([0.4, 0.2])
    assert torch.equal(sigma_root(left, right), sigma_root(left, right, True))
    assert not torch.equal(sigma_root(left, right), sigma_root(left, right, False))


def test_metrics_of_any_batch():
    hit = torch.zeros(2, 3, 4, dtype=torch.bool)
    hit[1, 2, 3] = True
    assert metrics.found(hit).tolist() == [[False] * 3, [False, False, True]]
    assert metrics.saccades_to_target(hit).tolist() == [[4] * 3, [4, 4, 3]]


def test_what_float32_could_not_invert_is_not_definite():
    thin = torch.tensor([1.0, 1 - 1.2e-7, 0, 1, 0, 1], dtype=torch.float64)
    assert bool(positive_definite(thin)) and not bool(positive_definite(thin.float()))


def test_the_midpoint_method_is_integrated_to_fourth_order():
    """The inverse of disparity D where rays miss each other by v: variance e²(1 + 4e²), as its docstring derives."""
    error = 0.05
    root = error * torch.eye(4, dtype=torch.float64)

    def inverse(x):
        return (x[..., :1] / (x[..., :1] ** 2 + x[..., 1:2] ** 2)).clone()

    mean = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    _, variance, _ = tf.unscented_transform(inverse, mean, root, SigmaPoints.midpoint())
    assert variance.item() == pytest.approx(error**2 * (1 + 4 * error**2), rel=1e-3)


def test_what_points_have_in_common_adds_to_their_covariance():
    """In the Cartesian chart; a cell without any stays as it is."""
    mean = torch.tensor([[0.3, 0.2, 2.0], [0.1, -0.4, 1.5]], dtype=torch.float64)
    cov = torch.tensor([[4e-3, 1e-3, 0, 5e-3, 0, 9e-3], [2e-3, 0, 1e-3, 3e-3, 0, 8e-3]], dtype=torch.float64)
    common = torch.tensor([1e-3, 2e-4, 0, 2e-3, 0, 3e-3], dtype=torch.float64).expand(3, 6)
    pooled = pool(Gaussian(mean, cov), torch.tensor([0, 2]), (3,))
    after = add_common(pooled, common, "cartesian").information
    found = gaussian_from_information(Information(after.vector[[0, 2]], after.matrix[[0, 2]]))
    torch.testing.assert_close(found.mean, mean)
    torch.testing.assert_close(found.cov, cov + common[:2])
    assert not after.vector[1].any() and not after.matrix[1].any() and not pooled.bearing.any()


def test_what_is_surely_an_error_shares_nothing():
    """With errors in common too: an observation that cannot be true is as one that was never made."""
    mean = torch.tensor([[0.0, 0, 2], [0, 0, 3]], dtype=torch.float64)
    cov = torch.tensor([[1e-4, 0, 0, 1e-4, 0, 4e-4], [1e-4, 0, 0, 1e-4, 0, 9e-4]], dtype=torch.float64)
    support, valid = torch.full((2,), 1e-3, dtype=torch.float64), torch.tensor([True, True])
    both = Observations(mean, cov, CELLS[[2, 2]], support, valid, inlier=torch.tensor([1.0, 0.0], dtype=torch.float64))
    one = Observations(*(part[:1] for part in both[:6]))
    kin = Kinship(torch.full((2,), 0.04, dtype=torch.float64), 0.5, torch.full((2,), 0.3, dtype=torch.float64))
    alone = kin._replace(patch=kin.patch[:1], lasting=kin.lasting[:1])
    found, expected = (
        remember(empty_memory(CELLS, Prior()), seen, Fusion(), kin=known) for seen, known in ((both, kin), (one, alone))
    )
    torch.testing.assert_close(found.information.matrix, expected.information.matrix)
    torch.testing.assert_close(found.information.vector, expected.information.vector)
    torch.testing.assert_close(found.lasting, expected.lasting)


def test_a_receptive_field_is_as_wide_as_its_own_camera_sees_it():
    left = torch.tensor([[8.0, 3.0], [-5.0, 1.0]], dtype=torch.float64)
    sigma = torch.full((2,), 0.1, dtype=torch.float64)
    matches = Correspondences(left, left - torch.tensor([2.0, 0.0]), sigma, sigma, sigma > 0)
    seen = eyes(Head(), Gaze(*(torch.tensor(v, dtype=torch.float64) for v in (0.1, 0.1, 0.1))))
    cameras = Pinhole(30.0), Pinhole(40.0, 3.0, 1.0)
    found, expected = (observe(matches, seen, pair, 2 * sigma) for pair in (cameras, cameras[:1] * 2))
    assert torch.equal(found.support_rad, expected.support_rad)


def test_directions_that_are_no_numbers_are_refused_and_rounding_is_forgiven():
    mixture = tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], [[0.1, 0.2, 0.3]], dtype=torch.float64)
    for value in (math.inf, math.nan):
        with pytest.raises(SettingError, match="directions = zero or not finite"):
            tf.log_density(mixture, torch.tensor([[1.0, 0.0, 1.0], [value, 0.0, 1.0]], dtype=torch.float64))
    for off, fine in ((0.9e-5, True), (1.5e-5, False)):
        cov = torch.eye(3, dtype=torch.float64)
        cov[0, 1] = off
        if fine:
            tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], cov[None])
        else:
            with pytest.raises(SettingError, match=r"covariances\[0\] = .*expected a symmetric"):
                tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], cov[None])


def test_quadratic_forms_and_rotations_are_those_of_whole_matrices():
    generator = torch.Generator().manual_seed(0)
    sym, vector = (torch.randn(2, 5, n, generator=generator, dtype=torch.float64) for n in (6, 3))
    turn = torch.linalg.qr(torch.randn(2, 5, 3, 3, generator=generator, dtype=torch.float64)).Q
    whole = unpack(sym)
    torch.testing.assert_close(quadratic3(sym, vector), torch.einsum("...i,...ij,...j->...", vector, whole, vector))
    torch.testing.assert_close(unpack(rotate3(turn, sym)), turn @ whole @ turn.mT)
    torch.testing.assert_close(rotate3(turn[0, 0], sym), rotate3(turn[0, 0].expand(2, 5, 3, 3), sym))


def test_inverse_range_at_a_cell_is_what_the_whole_matrix_says():
    generator = torch.Generator().manual_seed(1)
    root = torch.randn(4, 3, 3, generator=generator, dtype=torch.float64)
    whole, vector = root @ root.mT, torch.randn(4, 3, generator=generator, dtype=torch.float64)
    for slope, weak in ((0.0, 0.0), (0.7, 0.0), (0.7, 0.2)):
        added = whole + torch.diag(torch.tensor([slope, slope, weak], dtype=torch.float64))
        mean, variance = nearness(Information(vector, pack(whole)), slope, torch.tensor(weak, dtype=torch.float64))
        cov = torch.linalg.inv(added)
        torch.testing.assert_close(variance, cov[:, 2, 2])
        torch.testing.assert_close(mean, (cov @ vector[..., None])[:, 2, 0])


def test_one_cell_can_be_drawn_and_few_in_a_hundred_thousand_cannot():
    mixture = tf.direction_mixture([1.0], [[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]])
    assert tf.sample(mixture, 1, 0).shape == (1, 3)
    with pytest.raises(SettingError, match="cells = 0: expected at least 1"):
        tf.sample(mixture, 0, 0)
    with pytest.raises(SettingError, match=r"reachable = \d+ of \d+ directions"):  # one in 20,000
        tf.sample(mixture, 100, 0, lambda directions: directions[:, 0] > 1 - 1e-4)


def test_a_ray_to_the_side_looks_not_ahead():
    right = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    for x, z, ahead in ((1.0, 0.0, False), (1.0, 1e-3, True), (1.0, -1e-3, False)):
        left = torch.tensor([[x, 0.0, z]], dtype=torch.float64)
        assert triangulate_rectified(left, right, torch.tensor(0.2, dtype=torch.float64))[2].tolist() == [ahead]


def test_of_sigma_points_all_must_look_ahead():
    """A fisheye's receptive field nearly at 90 degrees: its centre is ahead, one standard deviation further out not."""
    camera = Fisheye(20.0)
    left = torch.tensor([[-20.0 * math.radians(89.0), 0.0]] * 2, dtype=torch.float64)
    sigma = torch.tensor([1e-3, 1.0], dtype=torch.float64)
    matches = Correspondences(left, left - torch.tensor([0.1, 0.0]), sigma, sigma, sigma > 0)
    seen = eyes(Head(), Gaze(*(torch.zeros((), dtype=torch.float64) for _ in range(3))))
    for chart in ("inverse_range", "cartesian"):
        assert observe(matches, seen, camera, sigma, chart=chart).valid.tolist() == [True, False]


def test_windows_and_ranges_end_and_what_votes():
    for name in ("window", "nearest_m"):
        with pytest.raises(SettingError, match=f"fusion.{name} = inf"):
            Fusion(**{name: math.inf})
    assert Fusion().votes and not Fusion(conflict=math.inf).votes and not Fusion("aligned").votes


def test_an_incumbent_belongs_to_a_row():
    mean = torch.zeros(4)
    for given in (torch.zeros(4), torch.zeros(1)):
        with pytest.raises(SettingError, match=r"incumbent.shape = .*: expected \(\), one for each row"):
            tf.expected_improvement(mean, mean + 1, given)
    with pytest.raises(SettingError, match=r"incumbent.shape = \(3,\): expected \(2,\), one for each row"):
        tf.expected_improvement(mean.expand(2, 4), mean.expand(2, 4) + 1, torch.zeros(3))


def test_where_a_saccade_alone_saw_a_patch():
    """By two observations beside its cell's middle, on a slope that nobody knows; beyond infinity as far as can be."""
    rows = torch.tensor([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.0]], dtype=torch.float64)
    rows, one = torch.nn.functional.normalize(rows, dim=-1), torch.ones(2, dtype=torch.float64)
    for sign, far_m in ((1, 1000.0), (-1, 1000.0), (-1, 50.0)):
        rho = sign * torch.tensor([0.4, 0.7], dtype=torch.float64)
        pooled = pool_patches(rho, 0.01 * one, 100 * one, rows, one, torch.tensor([1, 1]), (3,))
        matrix = unpack(pooled.information.matrix[1]) + torch.diag(torch.tensor([4.0, 4.0, 0.0], dtype=torch.float64))
        there = float(torch.linalg.solve(matrix, pooled.information.vector[1])[2])
        points = found_points(pooled, CELLS[:3], "inverse_range", 0.5, far_m)
        torch.testing.assert_close(points[1], CELLS[1] / max(there, 1 / far_m))
        assert torch.equal(points[[0, 2]], CELLS[[0, 2]])


def test_what_a_look_has_in_common_makes_it_say_less():
    """1/(u + c) of a variance u, beside another c that all of the look shares."""
    one = Observations(
        torch.tensor([[0.0, 0, 2]], dtype=torch.float64),
        torch.tensor([[1e-9, 0, 0, 1e-9, 0, 4e-4]], dtype=torch.float64),
        CELLS[[2]],
        torch.full((1,), 1e-3, dtype=torch.float64),
        torch.tensor([True]),
    )
    common = torch.tensor([0, 0, 0, 0, 0, 3e-4], dtype=torch.float64).expand(12, 6)
    empty = empty_memory(CELLS, Prior())
    for given, variance in ((None, 4e-4), (common, 7e-4)):
        told = (remember(empty, one, Fusion(), given).information.matrix - empty.information.matrix)[2, 5]
        assert float(told) == pytest.approx(1 / variance, rel=1e-4)


def test_what_lasts_weighs_as_the_look_does_on_a_slope_too():
    """1/u of a look by itself: its own variance, and that of the slope from where it looked to the cell's middle."""
    prior = Prior(slope_std=0.6)
    beside = torch.nn.functional.normalize(CELLS[[2]] + torch.tensor([0.02, -0.03, 0.01], dtype=torch.float64), dim=-1)
    mean, cov = torch.tensor([[0.0, 0, 2]], dtype=torch.float64), torch.tensor([[1e-9, 0, 0, 1e-9, 0, 4e-4]])
    support, patch = torch.full((1,), 1e-3, dtype=torch.float64), torch.full((1,), 1e-9, dtype=torch.float64)
    look = Observations(mean, cov.double(), beside, support, torch.tensor([True]))
    memory = remember(empty_memory(CELLS, prior), look, Fusion(), kin=Kinship(patch, 1e-9, 0 * patch + 0.3))
    cell = int(memory.looks.argmax())
    cosine = float((beside[0] * CELLS[cell]).sum())
    # of a plane q·X = 1 the inverse range along the look is ρ cos θ + g sin θ, from which ρ follows
    variance = (4e-4 + 0.6**2 * (1 - cosine**2)) / cosine**2
    assert float(memory.lasting[cell, 0]) == pytest.approx((0.3 * 4e-4 / cosine**2) ** 0.5 / variance, rel=1e-3)


def test_what_is_in_common_is_added_to_each_of_a_batch():
    generator = torch.Generator().manual_seed(2)
    rows = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator, dtype=torch.float64), dim=-1)
    one, cell = torch.ones(40, dtype=torch.float64), torch.arange(40) % 6
    common = torch.rand(2, 3, 1, generator=generator, dtype=torch.float64) * torch.tensor([1e-3, 0, 0, 1e-3, 0, 2e-3])
    together = add_common(
        pool_patches(0.5 * one, 0.01 * one, 9 * one, rows, one, cell, (2, 3)), common, "inverse_range"
    )
    alone = add_common(
        pool_patches(0.5 * one, 0.01 * one, 9 * one, rows, one, cell, (6,)), common.reshape(6, 6), "inverse_range"
    )
    for found, expected in zip(together.information, alone.information, strict=True):
        torch.testing.assert_close(found.reshape(expected.shape), expected)
