"""Which surface a cell believes in, and what its looks have in common: against loops and Monte Carlo."""

import dataclasses
import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchfovea.gaussian import Gaussian, columns, information_from_gaussian
from torchfovea.memory.egosphere import Fusion, Prior, belief, cartesian_belief, empty_memory, reducible, trust
from torchfovea.memory.pooling import pool_patches, share_errors
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.update import fuse, remember
from torchfovea.memory.voting import Sight, against, cast, within_sight
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Budget, Clues, Correspondences
from torchfovea.sensing.head import Eyes, Gaze, Head, eyes
from torchfovea.sensing.kinship import Kinship, kinship, lasting_share
from torchfovea.sensing.layout import LogPolar
from torchfovea.sensing.triangulation import Observations

AHEAD = torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
PRIOR, FUSION = Prior(), Fusion(gate_deg=5)


def look(rho: float, inlier: float = 1.0, fields: int = 9, sigma: float = 0.01) -> Observations:
    """Fields that see one inverse range straight ahead, exactly."""
    direction = AHEAD.expand(fields, 3).contiguous()
    one = torch.ones(fields, dtype=torch.float64)
    zero = torch.zeros_like(one)
    cov = columns(1e-9 * one, zero, zero, 1e-9 * one, zero, sigma**2 * one)
    valid = torch.ones(fields, dtype=torch.bool)
    return Observations(columns(zero, zero, rho * one), cov, direction, 0.01 * one, valid, inlier * one)


def after(*looks: Observations, kin: Kinship | None = None):
    memory = empty_memory(AHEAD, PRIOR)
    for seen in looks:
        memory = remember(memory, seen, FUSION, None, kin)
    return memory


def counted(sight, patches, seen, votes, first, limits):
    """`cast` as its docstring says it, one cell after the other."""
    mean, std, slope = first
    conflict, window, nearest = limits
    keep, anew, out = torch.zeros_like(sight.rho), [], []
    for c in range(len(seen)):
        mine = [k for k in range(len(sight.rho)) if sight.cell[k] == c]
        row = sight.row[mine]
        g, packed = patches[0][c], patches[1][c]
        a, b, d, e, f, h = packed.tolist()
        full = torch.tensor([[a, b, d], [b, e, f], [d, f, h]], dtype=torch.float64)
        agree, rest = [], []
        for k, r in zip(mine, row, strict=True):
            spread = sight.variance[k] + r @ full @ r
            agree += [k] if seen[c] and (sight.rho[k] - r @ g) ** 2 < conflict**2 * spread else []
        rest = [k for k in mine if k not in agree]
        std_of = {
            k: math.sqrt(sight.variance[k] + slope**2 * (sight.row[k, 0] ** 2 + sight.row[k, 1] ** 2)) for k in rest
        }
        edge = max(
            [float(sight.rho[k]) - conflict * std_of[k] for k in rest if sight.inlier[k] > 0.5], default=-math.inf
        )
        ahead = [k for k in rest if float(sight.rho[k]) + conflict * std_of[k] >= edge]
        odds = {
            k: min(1.0, math.exp(-(((sight.rho[k] - mean) / std) ** 2) / 2) / (std * math.sqrt(2 * math.pi) * nearest))
            for k in ahead
        }
        hits = len(agree) + len(ahead)
        yes, no = votes[c].tolist()
        pro = contra = 0.0
        if hits:
            pro = sum(float(sight.inlier[k]) for k in agree) / hits
            believed = [(float(sight.inlier[k]), odds[k]) for k in ahead]
            contra = sum(i * o / max(i * o + 1 - i, 1e-12) for i, o in believed) / hits
        was = yes
        yes, no = yes + pro, no + (0 if not hits else (1 - pro if agree else contra))
        new = hits > 0 and (not seen[c] or (no > 1.001 * yes and contra > pro))
        if new:
            yes, no = contra, (was if seen[c] else 0.0) + 1 - contra
        for k in ahead if new else agree:
            keep[k] = sight.inlier[k]
        total = max(window, yes + no)
        out.append((yes * window / total, no * window / total))
        anew.append(new)
    return keep, torch.tensor(anew), torch.tensor(out, dtype=torch.float64)


@given(st.integers(0, 10_000))
def test_votes_are_counted_as_in_a_loop(seed):
    rng = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    count, cells = 40, 6
    cell = torch.randint(0, cells, (count,), generator=rng)
    truth = torch.where(rand(cells) < 0.5, 0.3, 1.2)
    rho = truth[cell] + torch.where(rand(count) < 0.3, rand(count), 0.02 * rand(count))
    row = columns(0.02 * rand(count), -0.02 * rand(count), torch.ones(count, dtype=torch.float64))
    sight = Sight(rho, 1e-4 + 1e-3 * rand(count), 1e4 * rand(count), row, 0.02 + 0.97 * rand(count), cell)
    zero = torch.zeros(cells, dtype=torch.float64)
    small = 1e-4 + 1e-3 * rand(cells)
    patches = (columns(zero, zero, truth), columns(small + 1, zero, zero, small + 1, zero, small))
    seen, votes = rand(cells) < 0.7, 3 * columns(rand(cells), rand(cells))
    given = (seen, votes, (0.4, 0.4, 1.5), (4.0, 5.0, 0.3))
    memory = empty_memory(fibonacci_directions(cells), PRIOR)
    known = information_from_gaussian(Gaussian(*patches))
    memory = memory._replace(information=known, looks=seen.to(votes), votes=votes)
    ballot, loop = cast(sight, memory, FUSION), counted(sight, patches, *given)
    torch.testing.assert_close(ballot.keep, loop[0])
    assert torch.equal(ballot.anew, loop[1])
    torch.testing.assert_close(ballot.votes, loop[2])


def test_what_no_one_doubts_is_believed_and_what_is_unseen_is_not():
    memory = empty_memory(AHEAD, PRIOR)
    assert trust(memory).item() == 0
    for rho in (0.01, 0.5, 3.0):
        assert trust(after(look(rho))).item() == 1
        assert trust(after(look(rho), look(rho))).item() == 1


def test_what_seems_very_near_must_be_seen_twice():
    near, usual = after(look(2.0, 0.97)), after(look(0.5, 0.97))
    assert trust(near).item() < 0.05 and trust(usual).item() > 0.95
    again = trust(after(look(2.0, 0.97), look(2.0, 0.97))).item()
    assert 0.4 < again < trust(after(*[look(2.0, 0.97)] * 6)).item() < 0.97


def test_doubt_that_lasts_is_not_outvoted_by_repetition():
    assert trust(after(*[look(0.4, 0.6)] * 50)).item() == pytest.approx(0.6, abs=0.02)


def test_a_surface_that_is_gone_fades_with_looks_that_miss_it():
    memory = after(*[look(1.2)] * 20)
    shares = []
    for _ in range(8):
        memory = memory._replace(votes=against(memory.votes, torch.tensor([True])))
        shares.append(trust(memory).item())
    assert all(later < sooner for sooner, later in pairwise([1.0, *shares]))
    assert shares[-1] < 0.5
    # and another that shows takes its place within the window
    assert belief(after(*[look(1.2)] * 20, *[look(0.3)] * 5)).mean[0, 2].item() == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(("fields", "patches"), [(1, 0.1), (12, 0.5), (40, 3.0)])
@pytest.mark.parametrize("alike", [True, False])
def test_what_fields_share_does_not_average_out(fields, patches, alike):
    rng, shared, runs = torch.Generator().manual_seed(0), 0.6, 40_000
    correlation = shared / (1 + patches)
    common = torch.randn(runs, 1, generator=rng, dtype=torch.float64)
    own = torch.randn(runs, fields, generator=rng, dtype=torch.float64)
    ones = torch.ones(fields, dtype=torch.float64)
    variance = 0.04 * (ones if alike else torch.linspace(0.2, 5, fields, dtype=torch.float64))
    error = (correlation**0.5 * common + (1 - correlation) ** 0.5 * own) * variance.sqrt()
    row, cell = columns(0 * ones, 0 * ones, ones), torch.zeros(fields, dtype=torch.int64)
    pooled = pool_patches(ones, variance, ones, row, ones, cell, (1,))
    root = variance.rsqrt().sum()
    precision = columns((1 / variance).sum(), root, 0.3**0.5 * root)[None]
    told, lasting = share_errors(pooled, precision, torch.tensor([patches], dtype=torch.float64), shared)
    claimed = 1 / told.information.matrix[0, 5].item()
    mean = (error / variance).sum(1) / (1 / variance).sum()
    assert mean.var().item() == pytest.approx(claimed, rel=0.03)
    # what is common is in the proportion of the standard deviations, and of it the part that lasts
    lasts = 0.3 / (1 + patches) * (precision[0, 1] / precision[0, 0]) ** 2
    assert lasting.item() == pytest.approx(lasts.item())


def test_what_lasts_between_looks_stays():
    rng, runs = torch.Generator().manual_seed(1), 20_000
    u = torch.tensor([0.04, 0.01, 0.02, 0.09], dtype=torch.float64)
    part = torch.tensor([0.3, 0.5, 0.2, 0.4], dtype=torch.float64) * u
    lasting = torch.randn(runs, 1, generator=rng, dtype=torch.float64) * part.sqrt()
    error = lasting + torch.randn(runs, 4, generator=rng, dtype=torch.float64) * (u - part).sqrt()
    weight = 1 / u
    actual = ((error * weight).sum(1) / weight.sum()).var().item()
    memory = empty_memory(AHEAD, Prior(mean=0.5, std=50.0))
    for one, lasts in zip(u, part, strict=True):
        ones = torch.ones(1, dtype=torch.float64)
        row = columns(0 * ones, 0 * ones, ones)
        pooled = pool_patches(0.5 * ones, one * ones, ones, row, ones, torch.zeros(1, dtype=torch.int64), (1,))
        memory = fuse(memory, pooled, columns(lasts.sqrt() / one, lasts / one**2)[None])
    assert belief(memory).cov[0, 5].item() == pytest.approx(actual, rel=0.03)


def test_a_memory_cannot_be_surer_than_what_lasts():
    patch, lasting = (torch.full((25,), x, dtype=torch.float64) for x in (0.04, 0.3))
    seen, kin = look(0.4, fields=25), Kinship(patch, 0.6, lasting)
    floor = 0.3 * 0.01**2 / 2  # the fields cover one patch
    variances = [belief(after(*[seen] * k, kin=kin)).cov[0, 5].item() for k in (1, 2, 10, 200)]
    assert all(later < sooner for sooner, later in pairwise(variances))
    assert floor < variances[-1] < 1.1 * floor
    assert belief(after(*[seen] * 200)).cov[0, 5].item() < 0.02 * floor


def test_kinship_counts_fields_by_the_patches_they_cover():
    retina = LogPolar(2000)
    px = retina.centers_px()
    sigma = torch.full_like(px[:, 0], 0.1)
    matches = Correspondences(px, px, sigma, sigma, sigma > 0)
    assert kinship(Budget.printed, retina, matches) is None and kinship(Budget(), retina, matches) is None
    kin = kinship(Budget(source_px=400, shared=0.5, shared_px=4, shared_widths=2, lasting=0.2), retina, matches)
    width = retina.width_px(px)
    length = torch.maximum(torch.full_like(width, 2.0), 2 * width)
    torch.testing.assert_close(kin.patch, width**2 / (2 * math.pi * length**2))
    assert (kin.lasting == 0.2).all()
    # fields that stand for twice as many, and know what of their error lasts
    told = matches._replace(support_px=width / math.sqrt(2), lasting=torch.rand_like(sigma))
    half = kinship(Budget(shared=0.5, shared_widths=2), retina, told)
    torch.testing.assert_close(half.patch, kin.patch * 2)
    assert half.lasting is told.lasting


def test_what_edges_and_doubts_make_of_a_variance_lasts():
    budget = Budget(bend=0.5, gap=0.2, fringe=0.1, noise=0.7, shared=0.6, lasting=0.3)
    one = torch.ones(1)
    clues = Clues(2 * one, one, 3 * one, 4 * one)
    edges = 2 * (1.0 + 0.04 + 0.09)
    share = lasting_share(budget, clues, torch.tensor([4.0]))
    assert share.item() == pytest.approx(0.3 + 0.7 * edges / 4)
    assert lasting_share(budget, Clues(0 * one, 0 * one), one).item() == pytest.approx(0.3)
    assert lasting_share(budget, clues, torch.tensor([edges])).item() == pytest.approx(1.0)
    doubtful = dataclasses.replace(budget, outliers=0.2)
    assert lasting_share(doubtful, Clues(0 * one, 0 * one), one).item() == pytest.approx(0.3 + 0.7 * 0.2)


def test_gradients_reach_inlier_probabilities():
    seen = look(0.6, 0.8, 4)
    inlier = seen.inlier.clone().requires_grad_()

    def figures(p):
        memory = after(seen._replace(inlier=p), seen._replace(inlier=p, mean=seen.mean + 0.001))
        return trust(memory), belief(memory).cov[..., 5]

    assert torch.autograd.gradcheck(figures, (inlier,))


def open_to_looks(memory) -> float:
    return reducible(memory, belief(memory).cov[..., 5]).item()


def test_what_lasts_is_not_worth_another_look():
    seen = look(0.4, fields=25)
    patch = torch.full((25,), 0.04, dtype=torch.float64)
    assert open_to_looks(after(*[seen] * 3)) == 1
    for share in (0.0, 0.3, 0.9):
        kin = Kinship(patch, 0.9, torch.full_like(patch, share))
        shares = [open_to_looks(after(*[seen] * k, kin=kin)) for k in (1, 2, 8, 64)]
        assert all(0 <= s <= 1 for s in shares)
        if share:
            assert all(later < sooner for sooner, later in pairwise(shares))
        else:
            assert shares == [1.0] * 4
    # of one look, what another would not repeat
    kin, variance = Kinship(patch, 0.9, torch.full_like(patch, 0.3)), 0.01**2
    first = after(seen, kin=kin)
    assert open_to_looks(first) * belief(first).cov[0, 5].item() == pytest.approx(
        belief(first).cov[0, 5].item() - 0.3 * variance / 2, rel=1e-3
    )


def test_what_a_look_should_have_shown_lies_on_both_retinas():
    """Of two memories at once, cell by cell against the pinhole's own formula; and only cells that are asked."""
    cells = fibonacci_directions(400).expand(2, 400, 3)
    memory = empty_memory(cells, Prior())
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(2, 400, generator=generator, dtype=torch.float64)
    vector = columns(0 * drawn, 0 * drawn, (3 * drawn - 0.5) * memory.information.matrix[..., 5])
    memory = memory._replace(information=type(memory.information)(vector, memory.information.matrix))
    cameras, retina = (Pinhole.from_fov(60.0, 100.0), Pinhole.from_fov(50.0, 100.0)), LogPolar(400)
    pose = eyes(Head(), Gaze(*torch.tensor([[0.4, -0.3], [0.1, 0.3], [0.2, 0.0]], dtype=torch.float64)))
    among = torch.rand(2, 400, generator=generator) < 0.7
    got = within_sight(memory, among, pose, cameras, retina)
    points = cartesian_belief(memory).mean
    for b in range(2):
        one = within_sight(empty_of(memory, b), among[b], Eyes(*(part[b] for part in pose)), cameras, retina)
        assert torch.equal(one, got[b]) and 5 < int(one.sum()) < 200
        for c in range(400):
            seen = bool(among[b, c])
            poses = ((pose.R_left, pose.t_left), (pose.R_right, pose.t_right))
            for camera, (rotation, origin) in zip(cameras, poses, strict=True):
                x, y, z = (rotation[b].T @ (points[b, c] - origin[b])).tolist()
                seen = seen and z > 0 and camera.focal_px * math.hypot(x, y) <= retina.radius_px * z
            assert seen == bool(got[b, c])


def empty_of(memory, b: int):
    """One memory of two that are alike but for their information."""
    one = empty_memory(memory.cells[b].contiguous(), memory.prior)
    return one._replace(information=type(one.information)(*(part[b] for part in memory.information)))
