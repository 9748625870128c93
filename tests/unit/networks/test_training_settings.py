"""How a network is trained."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.networks import training_state
from stereobench.networks.training_state import TrainingSettings


def test_the_learning_rate_is_halved_every_ten_epochs() -> None:
    rates = [training_state.learning_rate_of(TrainingSettings(), epoch) for epoch in (0, 9, 10, 25)]
    assert rates == [1e-3, 1e-3, 5e-4, 2.5e-4]
