"""Benchmarks against torch and the baselines (`make bench`)."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUNDLE = ROOT / "policies" / "lpac_l2_k3_n10_512"
CHECKPOINT = BUNDLE.with_suffix(".pt")
