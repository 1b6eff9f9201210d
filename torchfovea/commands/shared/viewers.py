"""What shows a search saccade by saccade: a film, a page to scrub through, a recording for Rerun's viewer."""

from __future__ import annotations

import base64
import html
import io
import json
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.commands.shared.mistakes import need
from torchfovea.commands.shared.settings import choice
from torchfovea.files import replacing
from torchfovea.metrics import global_information
from torchfovea.perception import Observer
from torchfovea.search import Glance
from torchfovea.sensing.head import gaze_point

__all__ = ["Show", "check_viewer", "viewers"]

Show = Callable[[int, Glance], None]

DPI = 70
FRAME_MS = 700


def check_viewer(cfg: DictConfig) -> bool:
    """Whether anything is to be shown, by the settings `viewer` and `video`.

    Raises:
        SettingError: for another viewer, and for one that is not installed.
    """
    viewer = "" if cfg.viewer is None else choice(cfg, "viewer", ("page", "rerun"))
    if viewer == "rerun":
        need("rerun")
    if viewer == "page" or cfg.video:
        need("matplotlib")
    return bool(viewer or cfg.video)


@contextmanager
def viewers(cfg: DictConfig, folder: Path, observer: Observer, name: str) -> Iterator[Show]:
    """What `check_viewer` allows: a function that takes every glance; its files are whole once the block ends.

    Args:
        cfg: with `viewer` (page, rerun or null) and `video`.
        folder: of the run.
        observer: of the search.
        name: of the files, NAME.gif, NAME.html and NAME.rrd.
    """
    with ExitStack() as stack:
        shows: list[Show] = []
        page = folder / f"{name}.html" if cfg.viewer == "page" else None
        film = folder / f"{name}.gif" if cfg.video else None
        if page is not None or film is not None:
            shows.append(stack.enter_context(frames(film, page, observer)))
        if cfg.viewer == "rerun":
            from torchfovea.commands.shared.rerun_log import rerun_log

            shows.append(stack.enter_context(rerun_log(folder / f"{name}.rrd", observer)))

        def show(t: int, glance: Glance) -> None:
            for one in shows:
                one(t, glance)

        yield show


@contextmanager
def frames(film: Path | None, page: Path | None, observer: Observer) -> Iterator[Show]:
    """Every glance as a picture: a GIF of them all, and an HTML page that holds them and a slider."""
    from PIL import Image

    from torchfovea.commands.shared.pictures import draw_glance

    path: list[Tensor] = []
    nats: list[float] = []
    pictures: list[Any] = []
    stills: list[tuple[str, str]] = []

    def show(t: int, glance: Glance) -> None:
        point = gaze_point(observer.head, glance.move.gaze).double().cpu()
        path.append(torch.nn.functional.normalize(point, dim=-1))
        nats.append(float(global_information(glance.step.points.cov)))
        away = float(point.norm())
        where = f"meet at {away:.2f} m" if math.isfinite(away) else "look straight ahead, side by side"
        line = f"fixation {t + 1}: the eyes {where}"
        figure = draw_glance(glance, torch.stack(path), nats, observer.retina, line)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI)
        buffer.seek(0)
        picture = Image.open(buffer).convert("RGB")
        if film is not None:
            # the ends of colour bars are rare and must stay what they are
            pictures.append(picture.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE))
        if page is not None:
            still = io.BytesIO()
            picture.save(still, format="JPEG", quality=85)
            stills.append((line, base64.b64encode(still.getvalue()).decode()))

    yield show
    if film is not None and pictures:
        with replacing(film) as temporary:
            pictures[0].save(
                temporary, format="GIF", save_all=True, append_images=pictures[1:], duration=FRAME_MS, loop=0
            )
    if page is not None and stills:
        with replacing(page) as temporary:
            temporary.write_text(_page(stills), encoding="utf-8")


def _page(stills: list[tuple[str, str]]) -> str:
    lines = json.dumps([line for line, _ in stills]).replace("<", "\\u003c")
    images = "".join(
        f'<img alt="{html.escape(line)}" src="data:image/jpeg;base64,{data}"{" hidden" if k else ""}>'
        for k, (line, data) in enumerate(stills)
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>A visual search, saccade by saccade</title>
<style>body{{font:16px/1.5 system-ui,sans-serif;margin:1rem auto;max-width:75rem;padding:0 1rem;color:#222}}
img{{width:100%;height:auto}}img[hidden]{{display:none}}input{{width:100%}}</style></head>
<body><h1>A visual search, saccade by saccade</h1>
<p><label for="t">Drag, or use the arrow keys. The ring is where the head looks next.</label>
<input id="t" type="range" min="0" max="{len(stills) - 1}" value="0" autofocus></p>
<p id="line" role="status">{html.escape(stills[0][0])}</p>{images}
<script>const lines={lines},images=document.querySelectorAll("img"),t=document.getElementById("t");
t.addEventListener("input",()=>{{images.forEach((image,k)=>image.hidden=k!=t.value);
document.getElementById("line").textContent=lines[t.value];}});</script></body></html>
"""
