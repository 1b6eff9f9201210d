"""Every pinned package has a licence that Apache-2.0 software may depend on."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
from licences import fitting, licence_of, pinned


def test_every_pinned_package_has_a_licence_that_fits():
    licences = [licence_of(name) for name in pinned()]
    assert len(licences) > 50 and sum(one.version is not None for one in licences) > 20
    assert [one for one in licences if one.fits is None] == []


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("MIT License", "MIT"),
        ("BSD 3-Clause License", "BSD-3-Clause"),
        ("MPL-2.0 AND MIT", "MPL-2.0 MIT"),
        ("Apache-2.0 OR BSD-2-Clause", "Apache-2.0 BSD-2-Clause"),
        ("GNU General Public License v3 (GPLv3)", None),
        ("GPL-3.0-or-later", None),
        ("LGPL-2.1", None),
        ("MIT AND AGPL-3.0", None),
        ("Proprietary", None),
        ("", None),
    ],
)
def test_what_fits(said, expected):
    assert fitting(said) == expected
