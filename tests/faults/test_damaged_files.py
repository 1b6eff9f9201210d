"""A damaged file is read as far as its damage cannot be told, or refused in one line that names it; nothing else."""

import random
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from damage import READERS, damaged, make_files

from torchfovea.commands.shared.images import read_levels
from torchfovea.files import write_tensors
from torchfovea.memory.store import load_memory
from torchfovea.setting import SettingError
from torchfovea.stereo.calibration_files import load_calibration
from torchfovea.stereo.disparity_files import load_disparity
from torchfovea.untrusted import Damaged, read_tensors

EACH = 40


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    make_files(folder)
    return folder


@pytest.mark.parametrize("name", READERS)
def test_one_line_or_an_answer(whole, name, inject, faults):
    path, read, source = whole / name, READERS[name], random.Random(name)
    content = path.read_bytes()
    read(path)
    refused = 0
    for _ in range(EACH * faults):
        path.write_bytes(damaged(content, source))
        try:
            read(path)
        except SettingError as error:
            refused += 1
            line = str(error)
            assert "\n" not in line and "expected" in line and str(path.parent) in line
    path.write_bytes(content)
    inject("damaged files", EACH * faults)
    assert refused > EACH // 10


@pytest.mark.parametrize("kind", ["png", "jpg", "tiff", "bmp", "ppm", "npy", "npz"])
def test_a_picture_that_is_cut_off_is_no_picture(whole, tmp_path, kind, inject):
    content = (whole / f"image.{kind}").read_bytes()
    for share in (0.0, 0.3, 0.7, 0.98):
        path = tmp_path / f"cut.{kind}"
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(SettingError, match=f"left = .*cut.{kind}: expected "):
            read_levels(path, "left")
        inject("damaged files")


def chunk(name: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")


def test_files_that_unfold_are_refused_before_they_do(tmp_path, inject):
    """A picture of 400 million pixels in 390 kB, arrays of terabytes in 200 bytes, a text of a billion laughs."""
    side, packer = 20000, zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + side)) for _ in range(side)) + packer.flush()
    head = side.to_bytes(4, "big") * 2 + bytes([8, 0, 0, 0, 0])
    picture = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(picture)
    (tmp_path / "bomb.pfm").write_bytes(b"Pf\n100000 100000\n-1.0\n" + bytes(100))
    array = np.lib.format.magic(1, 0) + (118).to_bytes(2, "little")
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }".ljust(117) + b"\n"
    (tmp_path / "bomb.npy").write_bytes(array + header + bytes(64))
    laughs = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"] + [
        f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 9)
    ]
    (tmp_path / "bomb.yaml").write_text("\n".join([*laughs, "camera_matrix: *a8"]))
    lines = ['<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a0 "1 ">']
    lines += [f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 9)]
    (tmp_path / "bomb.xml").write_text("".join(lines) + "]><opencv_storage><M1>&a8;</M1></opencv_storage>")
    (tmp_path / "bomb.json").write_text('{"type_id": "opencv-matrix", "a": ' + "[" * 100000)
    script = (
        "import sys, torch, resource; from pathlib import Path\n"
        "from torchfovea.setting import SettingError\n"
        "from torchfovea.commands.shared.images import read_levels\n"
        "from torchfovea.stereo.disparity_files import load_disparity\n"
        "from torchfovea.stereo.calibration_files import load_calibration\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "for path in map(Path, sys.argv[1:]):\n"
        "    for read in (lambda p: read_levels(p, 'left'), lambda p: load_disparity(p, 'truth', unit_px=1.0),\n"
        "                 lambda p: load_calibration([p], (9, 9))):\n"
        "        try: print(read(path))\n"
        "        except SettingError as error: assert path.name in str(error), error\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)\n"
    )
    bombs = sorted(tmp_path.iterdir())
    done = subprocess.run([sys.executable, "-c", script, *bombs], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 200, done.stdout  # MB
    inject("bombs", len(bombs))


def test_arrays_of_more_than_a_bound_are_not_unpacked(tmp_path, monkeypatch, inject):
    from torchfovea import untrusted

    np.savez_compressed(tmp_path / "large.npz", disparity=np.zeros((100, 100)))
    np.save(tmp_path / "large.npy", np.zeros((100, 100)))
    monkeypatch.setattr(untrusted, "MOST_BYTES", 79999)
    for name in ("large.npz", "large.npy"):
        with pytest.raises(SettingError, match="more than 79999 are not read"):
            load_disparity(tmp_path / name, "truth")
        inject("bombs")


class Runs:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (Path(self.path),)


def test_nothing_in_a_file_is_run(tmp_path, inject):
    witness = tmp_path / "witness"
    torch.save({"state": Runs(witness)}, tmp_path / "checkpoint.pt")
    with pytest.raises(Damaged):
        read_tensors(tmp_path / "checkpoint.pt")
    objects = np.array([Runs(witness)], dtype=object)
    np.save(tmp_path / "objects.npy", objects)
    np.savez(tmp_path / "objects.npz", disparity=objects, cells=objects)
    (tmp_path / "objects.yaml").write_text(f"camera_matrix: !!python/object/apply:os.mknod ['{witness}']\n")
    for read, name in (
        (lambda p: load_disparity(p, "truth"), "objects.npy"),
        (lambda p: load_disparity(p, "truth"), "objects.npz"),
        (lambda p: read_levels(p, "left"), "objects.npy"),
        (load_memory, "objects.npz"),
        (lambda p: load_calibration([p], (9, 9)), "objects.yaml"),
    ):
        with pytest.raises(SettingError, match=name):
            read(tmp_path / name)
        inject("files with code")
    assert not witness.exists()
    torch.load(tmp_path / "checkpoint.pt", weights_only=False)  # they would have run
    assert witness.exists()


def test_what_was_written_is_read(tmp_path):
    content = {"a": torch.arange(3.0), "b": [(1, 2.5, "c")], "d": None}
    write_tensors(tmp_path / "it.pt", content)
    found = read_tensors(tmp_path / "it.pt")
    assert torch.equal(found.pop("a"), content.pop("a")) and found == content
