"""The ground floor stays light, and what it exports is what it documents."""

import subprocess
import sys

import ogm.evidence
from ogm.evidence import powerset


def test_importing_loads_no_heavy_package() -> None:
    code = "import sys, ogm.evidence; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    modules = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert "numpy" in modules
    assert not {"torch", "numba", "matplotlib", "open3d", "pandas", "mpmath"} & set(modules)


def test_computing_loads_no_heavy_package() -> None:
    code = """
import sys, numpy as np
from ogm import evidence
a = np.array([0.5, 0.2])
evidence.dempster(a, a), evidence.dirichlet_kl(a, a), evidence.mass_to_evidence(a), evidence.cautious(a, a)
assert not {"torch", "numba"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_every_export_exists_and_has_documentation() -> None:
    for module in (ogm.evidence, powerset):
        assert sorted(module.__all__) == list(module.__all__)
        for name in module.__all__:
            assert getattr(module, name).__doc__, name
