"""The fence's lines."""

from edge.core.fence import Fence


def test_a_buffers_line_does_not_cross_itself() -> None:
    """Its short edges may be gone."""
    corners = ((0.0, 0.0), (32.0, 0.0), (32.0, 31.9), (31.9, 32.0), (0.0, 32.0))
    fence = Fence(corners, buffer_m=1.5, floor_m=2.0, ceiling_m=100.0)
    assert set(fence.grown_m(-1.5)) == {(1.5, 1.5), (30.5, 1.5), (30.5, 30.5), (1.5, 30.5)}
