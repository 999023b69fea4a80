"""Looks on torch tensors are the looks on arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from evermap.errors import InputError, NumericalError
from evermap.existence.batch import Looked
from evermap.types import FloatArray

from .rows import look_exponential, look_general_purpose, look_two_state

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'evermap[torch]'")

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
N = 400


def parameters_of(look: Callable[..., Any], random: np.random.Generator) -> tuple[FloatArray, ...]:
    if look is look_exponential:
        return (10 ** random.uniform(-6, 0, N),)
    if look is look_two_state:
        return 10 ** random.uniform(-6, 0, N), 10 ** random.uniform(-6, 0, N)
    return 10 ** random.uniform(-7, -3, N), 10 ** random.uniform(-2.5, 2, N)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("horizon_s", [0.0, 40.0])
@pytest.mark.parametrize("look", [look_exponential, look_general_purpose, look_two_state])
@pytest.mark.parametrize(("name", "tolerance"), [("float32", 1e-6), ("float64", 1e-12)])
def test_tensors_give_what_arrays_give(
    look: Callable[..., Any], horizon_s: float, name: str, tolerance: float, device: str
) -> None:
    """Sixty looks one after the other from the same numbers, each road with its own state."""
    random = np.random.default_rng(5)
    kind = getattr(torch, name)

    def rounded(values: FloatArray) -> FloatArray:
        return values.astype(name).astype(np.float64)

    def tensor(values: FloatArray) -> Any:
        return torch.tensor(values, dtype=kind, device=device)

    parameters = tuple(rounded(p) for p in parameters_of(look, random))
    stamp = np.zeros(N)
    arrays, tensors = Looked(np.zeros(N), np.ones(N)), Looked(tensor(np.zeros(N)), tensor(np.ones(N)))
    for _ in range(60):
        time = rounded(stamp + random.choice([0.0, 1e-3, 1.0, 100.0, 1e4], N))
        seen, miss, false = random.random(N) < 0.5, rounded(random.random(N)), rounded(random.random(N))
        looked = torch.tensor(seen, device=device)
        arrays = look(arrays.inverse_odds, stamp, *parameters, time, seen, miss, false, horizon_s=horizon_s)
        columns = (tensor(column) for column in (stamp, *parameters, time))
        tensors = look(tensors.inverse_odds, *columns, looked, tensor(miss), tensor(false), horizon_s=horizon_s)
        stamp = time
        assert tensors.inverse_odds.dtype == tensors.probability.dtype == kind
        assert tensors.probability.device.type == device
        np.testing.assert_allclose(tensors.probability.cpu().numpy(), arrays.probability, rtol=0.0, atol=tolerance)
    if name == "float64":
        np.testing.assert_allclose(tensors.inverse_odds.cpu().numpy(), arrays.inverse_odds, rtol=1e-9)


@pytest.mark.parametrize("name", ["float32", "float64"])
def test_certainties_and_limits(name: str) -> None:
    """Proof of presence, proof of absence, a lifetime that never ends, certain death; doubt stays finite."""

    def tensor(*values: float) -> Any:
        return torch.tensor(values, dtype=getattr(torch, name))

    stamp, time, rate = tensor(0, 0, 0, 0), tensor(1, 1, 1, 1), tensor(1, 1, 0, 1e9)
    seen, miss, false = torch.tensor([True, False, False, False]), tensor(0.5, 0, 0.5, 0.5), tensor(0, 0.5, 0.5, 0.5)
    look = look_exponential(tensor(3, 3, 0, 0.5), stamp, rate, time, seen, miss, false)
    assert look.inverse_odds[:3].tolist() == [0.0, np.inf, 0.0]
    assert look.inverse_odds[3].isfinite()
    assert look.probability[:3].tolist() == [1.0, 0.0, 1.0]
    assert look.probability[3] < 1e-30
    surely = tensor(1e-36, 1e-36, 1e36, 1e36) if name == "float32" else tensor(1e-299, 1e-299, 1e299, 1e299)
    hit, low, high = torch.tensor([True, True, False, False]), tensor(0, 0, 0, 0) + 1e-20, tensor(0, 0, 0, 0) + 1e-10
    after = look_general_purpose(surely, time, low, high, time, hit, 0 * miss + 1e-4, 0 * miss + 1e-4).inverse_odds
    assert (after > 0.0).all()
    assert after.isfinite().all()


def test_what_is_refused() -> None:
    ones, seen = torch.ones(3), torch.ones(3, dtype=torch.bool)
    early = torch.tensor([2.0, 0.5, 2.0])
    with pytest.raises(InputError, match=r"row 1: time 0\.5 s lies before"):
        look_exponential(ones, ones, ones, early, seen, 0.5 * ones, 0.5 * ones)
    with pytest.raises(InputError, match=r"'p_miss': row 0: 2\.0 is not a probability"):
        look_general_purpose(ones, ones, ones, 2 * ones, ones, seen, 2 * ones, 0.5 * ones)
    with pytest.raises(NumericalError, match=r"row 0.*impossible"):
        look_exponential(ones, ones, ones, ones, seen, ones, 0 * ones)
    with pytest.raises(InputError, match="'low_hz': row 0"):
        look_general_purpose(ones, ones, 2 * ones, ones, ones, seen, 0.5 * ones, 0.5 * ones)
    with pytest.raises(InputError, match="'rate_hz': row 0"):
        look_exponential(ones, ones, -ones, ones, seen, 0.5 * ones, 0.5 * ones)
    with pytest.raises(InputError, match=r"'p_miss'.*not a tensor on cpu"):
        look_exponential(ones, ones, ones, ones, seen, np.ones(3), 0.5 * ones)
    with pytest.raises(InputError, match=r"'detected'.*float32"):
        look_exponential(ones, ones, ones, ones, ones, 0.5 * ones, 0.5 * ones)
    with pytest.raises(InputError, match=r"'time_s'.*shape \(2,\) instead of \(3,\)"):
        look_exponential(ones, ones, ones, ones[:2], seen, 0.5 * ones, 0.5 * ones)
    with pytest.raises(InputError, match="'out'"):
        look_exponential(ones, ones, ones, ones, seen, 0.5 * ones, 0.5 * ones, out=Looked(ones, ones))
