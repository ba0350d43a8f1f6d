import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dsrc.ops.anchors import anchor_grid
from dsrc.ops.coding import REFERENCE_ORDER, decode, encode
from dsrc.ops.grid import GridSpec
from tests.paths import GOLDENS

GOLDEN = GOLDENS / "models" / "targets.npz"
ANCHORS = anchor_grid(GridSpec(range_m=(-25.6, -12.8, -3, 25.6, 12.8, 1)))

boxes = arrays(np.float64, (5, 7), elements=st.floats(0.1, 50.0))


def test_decoding_equals_the_released_code() -> None:
    golden = np.load(GOLDEN)
    deltas = golden["decode_in"].reshape(2, 2, 7, 32, 64).transpose(0, 3, 4, 1, 2)[..., REFERENCE_ORDER]
    expected = golden["decode_out"].reshape(2, 32, 64, 2, 7)[..., REFERENCE_ORDER]
    np.testing.assert_allclose(decode(deltas, ANCHORS), expected, rtol=1e-5, atol=1e-5)


@given(boxes, boxes)
def test_decode_undoes_encode(box: np.ndarray, anchor: np.ndarray) -> None:
    np.testing.assert_allclose(decode(np.clip(encode(box, anchor), -1e9, 1e9), anchor)[:, :3], box[:, :3], atol=1e-6)
    small = np.clip(box, 1.0, 20.0)
    anchor = np.clip(anchor, 1.0, 20.0)
    np.testing.assert_allclose(decode(encode(small, anchor), anchor), small, rtol=1e-12, atol=1e-9)


def test_a_network_gone_astray_gives_finite_boxes() -> None:
    wild = decode(np.full((1, 7), 1e4), np.ones((1, 7)))
    assert np.isfinite(wild).all()
