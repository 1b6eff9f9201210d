"""Loading MuJoCo so that a machine without graphics can still cast rays and simulate."""

from __future__ import annotations

import ctypes
import os
import sys
from types import ModuleType

from torchfovea.setting import SettingError

__all__ = ["load_mujoco", "loadable_gl"]

_LIBRARIES = {"egl": ("libEGL.so.1", "libEGL.so"), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")}


def loadable_gl(backend: str) -> bool:
    """Whether the shared library of a GL backend ("egl" or "osmesa") can be loaded; no context is made."""
    for library in _LIBRARIES[backend]:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False


def load_mujoco() -> ModuleType:
    """Import MuJoCo, with a GL backend that exists, or none.

    An environment variable ``MUJOCO_GL`` that names a missing library makes ``import mujoco`` itself fail, although
    rays and physics need no GL; it is set aside for the import then. Unset, it becomes the first of EGL and OSMesa that
    exists.

    Raises:
        SettingError: MuJoCo cannot be imported.
    """
    if "mujoco" not in sys.modules:
        asked = os.environ.get("MUJOCO_GL", "").lower().strip()
        if asked in _LIBRARIES and not loadable_gl(asked):
            del os.environ["MUJOCO_GL"]
            asked = ""
        if not asked:
            found = next((name for name in _LIBRARIES if loadable_gl(name)), None)
            if found:
                os.environ["MUJOCO_GL"] = found
    try:
        import mujoco
    except Exception as error:  # a broken GL set-up raises AttributeError or OSError, not ImportError
        raise SettingError(
            f"mujoco = {type(error).__name__}: {error}: expected an importable MuJoCo (try MUJOCO_GL=disable)"
        ) from error
    module: ModuleType = mujoco
    return module
