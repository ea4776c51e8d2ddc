"""What many tests share: the shipped policy."""

from pathlib import Path

import pytest

from edge.runtime.bundle import Bundle, load_bundle
from edge.runtime.policy import Policy

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "policies" / "lpac_l2_k3_n10_512"


@pytest.fixture(scope="session")
def shipped_bundle() -> Bundle:
    return load_bundle(SHIPPED)


@pytest.fixture(scope="session")
def shipped_policy(shipped_bundle: Bundle) -> Policy:
    return Policy(shipped_bundle)
