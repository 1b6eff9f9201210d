"""A search as a recording for Rerun's viewer (extra `rerun`): images, points and ellipsoids, the ego-sphere, gazes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.files import replacing
from torchfovea.gaussian import unpack
from torchfovea.metrics import global_information, information
from torchfovea.perception import Observer
from torchfovea.search import Glance
from torchfovea.sensing.correspondence import Disparity
from torchfovea.sensing.head import eyes, gaze_point
from torchfovea.sensing.retina import kept

__all__ = ["rerun_log"]

ELLIPSOIDS = 600  # more hide each other
SPHERE_M = 0.25  # radius that the ego-sphere is drawn with


@contextmanager
def rerun_log(path: Path, observer: Observer) -> Iterator[Callable[[int, Glance], None]]:
    """A function that takes every glance, on the time line `saccade`; the file is whole once the block ends.

    Args:
        path: the .rrd to write.
        observer: of the search.
    """
    import rerun as rr

    with replacing(path) as temporary:
        stream = rr.RecordingStream("torchfovea")
        stream.save(str(temporary))
        stream.log("ego", rr.ViewCoordinates.FLU, static=True)
        scan: list[list[float]] = []

        def show(t: int, glance: Glance) -> None:
            stream.set_time("saccade", sequence=t)
            _images(rr, stream, glance, observer)
            _memory(rr, stream, glance)
            pose = eyes(observer.head, glance.move.gaze)
            meet = gaze_point(observer.head, glance.move.gaze)
            scan.append(meet.tolist())
            rays = [[centre.tolist(), meet.tolist()] for centre in (pose.t_left, pose.t_right)]
            stream.log("ego/gaze", rr.LineStrips3D(rays, colors=[[230, 159, 0]]))
            stream.log("ego/scan_path", rr.LineStrips3D([scan], colors=[[80, 80, 80]]))
            stream.log("curves/information_nats", rr.Scalars(float(global_information(glance.step.points.cov))))

        yield show
        stream.flush()
        stream.disconnect()


def _images(rr: Any, stream: Any, glance: Glance, observer: Observer) -> None:
    pictures = None if glance.look is None else glance.look.pictures
    if pictures is None:
        return
    retina = observer.retina
    for name in ("left", "right"):
        image = getattr(pictures, name).detach().cpu().float()
        stream.log(f"eyes/{name}/image", rr.Image(_bytes(image)))
        stream.log(f"eyes/{name}/kept", rr.Image(_bytes(kept(image, retina))))
    if isinstance(pictures.found, Disparity):
        found = torch.where(pictures.found.valid, pictures.found.disparity, torch.zeros_like(pictures.found.disparity))
        stream.log("eyes/disparity_px", rr.DepthImage(found.detach().cpu().float().numpy(), meter=1.0))


def _memory(rr: Any, stream: Any, glance: Glance) -> None:
    memory, points = glance.step.memory, glance.step.points
    nats = information(points.cov).cpu()
    colours = _colours(nats)
    stream.log("ego/sphere", rr.Points3D((SPHERE_M * memory.cells).cpu().numpy(), colors=colours, radii=0.002))
    seen = (memory.looks > 0).cpu()
    mean, cov = points.mean.cpu()[seen], points.cov.cpu()[seen]
    stream.log("ego/points", rr.Points3D(mean.numpy(), colors=colours[seen.numpy()], radii=0.006))
    some = torch.linspace(0, max(len(mean) - 1, 0), min(ELLIPSOIDS, len(mean))).round().long()
    spread, axes = torch.linalg.eigh(unpack(cov[some].double()))
    axes = torch.where((torch.linalg.det(axes) < 0)[:, None, None], -axes, axes)
    stream.log(
        "ego/ellipsoids",
        rr.Ellipsoids3D(
            centers=mean[some].numpy(),
            half_sizes=spread.clamp(min=0).sqrt().numpy(),
            quaternions=_quaternions(axes),
            colors=colours[seen.numpy()][some.numpy()],
        ),
    )


def _quaternions(rotation: Tensor) -> np.ndarray:
    """Of rotation matrices (N, 3, 3), as x, y, z, w."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation.numpy()).as_quat()) if len(rotation) else np.zeros((0, 4))


def _colours(nats: Tensor) -> np.ndarray:
    """Dark blue for what is hardly known, yellow for what is known best (a straight way through cividis), (N, 3)."""
    low, high = torch.quantile(nats.double(), nats.new_tensor([0.02, 0.98]).double())
    share = ((nats - low) / (high - low).clamp(min=1e-6)).clamp(0, 1).double().numpy()[:, None]
    return np.asarray((1 - share) * np.array([0, 34, 78]) + share * np.array([254, 232, 56]), np.uint8)


def _bytes(image: Tensor) -> np.ndarray:
    return (image.movedim(0, -1).clamp(0, 1) * 255).round().byte().numpy()
