"""What a memory rules out along an eye's rays: a surface that is surely there hides what is behind it."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchfovea.memory.egosphere import FAR_M, Memory, inverse_range_belief
from torchfovea.setting import require

__all__ = ["hidden_beyond"]

AROUND = 9  # cells about a ray, as the eye sees them: both surfaces of an edge are among them
APART = 3.0  # spacings; where the nearest cell is farther off, nothing is known of the ray
FOR, AGAINST = 1.5, 0.25  # looks for a cell's surface, and those against it as a share of them


@torch.no_grad()
def hidden_beyond(memory: Memory, origin: Tensor, rays: Tensor, sigmas: float = 3.0) -> Tensor:
    """Inverse range from an eye below which nothing can be seen, because the memory knows a surface in front of it.

    Nothing is ruled out that is nearer than what is known, so that what comes between is found at once. A cell rules
    out something if two looks spoke for its surface and hardly any against it: a look that misses it, or finds another,
    gives the whole range back.

    Args:
        memory: one, of patches whose cells vote.
        origin: of the rays in E, (3,).
        rays: (N, 3) in E, of any positive length.
        sigmas: so many standard deviations behind the surface something may still be.

    Returns:
        (N,) [1/m]; 0 where nothing is ruled out. Not differentiable.

    Raises:
        SettingError: for a batch, and a memory of points, which have no votes.
    """
    patches = memory.chart == "inverse_range" and memory.cells.dim() == 2
    require(patches, "matcher.volume", "memory", "all, or one memory of patches, fusion=inverse_range")
    rho, variance = inverse_range_belief(memory)
    yes, no = memory.votes.unbind(-1)
    known = (yes >= FOR) & (no <= AGAINST * yes)
    if not bool(known.any()):
        return rays.new_zeros(len(rays))
    rho = rho.clamp(min=1 / FAR_M)
    point = memory.cells / rho[:, None] - origin
    away = point.norm(dim=-1)
    least = torch.where(known, (rho - sigmas * variance.sqrt()).clamp(min=0) / (rho * away), 0.0)
    unit = torch.nn.functional.normalize(rays, dim=-1)
    tree, count = cKDTree((point / away[:, None]).double().cpu().numpy()), min(AROUND, len(rho))
    chord, near = tree.query(unit.double().cpu().numpy(), list(range(1, count + 1)))
    near, chord = torch.from_numpy(near).to(rho.device), torch.from_numpy(chord[:, 0]).to(rho)
    here = chord <= APART * memory.spacing_rad[near[:, 0]]
    return torch.where(here, least[near].amin(-1), 0.0)
