"""What a memory knows as a coloured cloud of points with covariances, for viewers and for other programs."""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfovea.files import replacing
from torchfovea.memory.egosphere import Memory, cartesian_belief, trust
from torchfovea.memory.moving import Motion
from torchfovea.memory.nearest import nearest_cell
from torchfovea.sensing.camera import Camera
from torchfovea.sensing.head import Eyes, to_ego

__all__ = ["COVARIANCE", "Cloud", "carried_colours", "cloud_of", "painted", "unpainted", "write_cloud", "write_ply"]

GREY = 0.5  # of points whose colour nobody saw
FRAME = "the ego frame: x forward, y left, z up, origin where the neck's pan and tilt axes cross"
COVARIANCE = "xx xy xz yy yz zz [m2]"


class Cloud(NamedTuple):
    """Points in the ego frame, one a cell that was seen.

    Attributes:
        mean: (N, 3) [m].
        cov: (N, 6), xx xy xz yy yz zz [m²].
        colour: (N, 3) in [0, 1].
        inlier: (N,), probability that the surface is there.
        looks: (N,), how many looks brought it something.
    """

    mean: Tensor
    cov: Tensor
    colour: Tensor
    inlier: Tensor
    looks: Tensor


def cloud_of(memory: Memory, colours: Tensor | None = None) -> Cloud:
    """The seen cells' points.

    Args:
        memory: one, (Nx, 3).
        colours: of its cells, (Nx, 3), from `painted`; None: all grey.
    """
    seen, moments = memory.looks > 0, cartesian_belief(memory)
    colours = unpainted(memory) if colours is None else colours
    return Cloud(*(part[seen] for part in (moments.mean, moments.cov, colours, trust(memory), memory.looks)))


def unpainted(memory: Memory) -> Tensor:
    """Grey for every cell, (Nx, 3): what `painted` begins with."""
    return torch.full_like(memory.cells, GREY)


def painted(colours: Tensor, looked: Tensor, points: Tensor, image: Tensor, camera: Camera, eyes: Eyes) -> Tensor:
    """Colours of cells after a look: those that it brought something have the left image's.

    Args:
        colours: before, (Nx, 3).
        looked: bool (Nx,), the cells that the look brought something.
        points: of the cells, (Nx, 3) in E.
        image: the left eye's, (3, H, W) in [0, 1].
        camera: in image pixels.
        eyes: where they were.
    """
    way = to_ego(eyes.R_left.mT, points - eyes.t_left)
    size = way.new_tensor([image.shape[-1] - 1, image.shape[-2] - 1])
    px = camera.project(way)
    within = looked & camera.in_view(way) & ((px >= -0.5) & (px <= size + 0.5)).all(-1)
    column, row = px.clamp(min=0).minimum(size).round().long().unbind(-1)
    return torch.where(within[:, None], image.to(colours)[:, row, column].T, colours)


def carried_colours(colours: Tensor, before: Memory, after: Memory, base: Motion) -> Tensor:
    """Colours of cells after the base moved: each seen cell has that of the cell its point was in before."""
    points = cartesian_belief(after).mean.double()
    then = points @ base.rotation.to(points).mT + base.translation.to(points)
    cell = nearest_cell(before.lookup, torch.nn.functional.normalize(then, dim=-1).to(before.cells))[0]
    return torch.where((after.looks > 0)[:, None], colours[cell], torch.full_like(colours, GREY))


def write_cloud(stem: str | os.PathLike[str], cloud: Cloud) -> None:
    """Write STEM.ply, for viewers, and STEM.npz, for programs; both say their frame and the covariances' order."""
    mean, cov, colour, inlier, looks = (part.detach().cpu().numpy() for part in cloud)
    write_ply(f"{os.fspath(stem)}.ply", mean, cov, colour, inlier)
    with replacing(f"{os.fspath(stem)}.npz") as path:
        np.savez_compressed(
            path,
            mean_m=mean,
            cov_m2=cov,
            colour=colour,
            inlier=inlier,
            looks=looks,
            frame=np.array(FRAME),
            cov_order=np.array(COVARIANCE),
        )


def write_ply(
    path: str | os.PathLike[str],
    mean: np.ndarray,
    cov: np.ndarray,
    colour: np.ndarray,
    inlier: np.ndarray,
    frame: str = FRAME,
) -> None:
    """Points as binary PLY, which every viewer opens; covariance and inlier probability travel as extra properties.

    Args:
        path: the file.
        mean: (N, 3) [m].
        cov: (N, 6), xx xy xz yy yz zz [m²].
        colour: (N, 3) in [0, 1].
        inlier: (N,) in [0, 1].
        frame: what the axes are, for the header's comment.
    """
    names = [*"xyz", *(f"cov_{c}" for c in ("xx", "xy", "xz", "yy", "yz", "zz")), "inlier"]
    record = np.dtype([(name, "<f4") for name in names] + [(name, "u1") for name in ("red", "green", "blue")])
    vertices = np.empty(len(mean), record)
    for name, column in zip(names, np.concatenate([mean, cov, inlier[:, None]], -1).T, strict=True):
        vertices[name] = column
    for name, column in zip(("red", "green", "blue"), colour.T, strict=True):
        vertices[name] = (column.clip(0, 1) * 255).round()
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {kinds[record[name].str]} {name}\n" for name in record.names or ())
    comments = f"comment metres, {frame}\ncomment covariance {COVARIANCE}\n"
    header = f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {len(mean)}\n{properties}end_header\n"
    with replacing(path) as temporary:
        temporary.write_bytes(header.encode() + vertices.tobytes())
