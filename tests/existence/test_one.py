"""The class for one feature, where it is more than the batch filter's arithmetic."""

from __future__ import annotations

import copy
import pickle

import pytest

from evermap.existence.one_stay import PersistenceFilter
from evermap.survival import LifetimePrior

from .priors import PRIORS


@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)
def test_filters_are_copied_and_sent_to_other_processes(prior: LifetimePrior) -> None:
    feature = PersistenceFilter(prior)
    feature.update(5.0, True, 0.1, 0.2)
    others = [copy.deepcopy(feature), pickle.loads(pickle.dumps(feature))]
    for other in (feature, *others):
        other.update(7.0, False, 0.3, 0.1)
        assert (other.stamp_s, other.inverse_odds, other.log_evidence) == (
            feature.stamp_s,
            feature.inverse_odds,
            feature.log_evidence,
        )
    others[0].update(8.0, False, 0.3, 0.1)
    assert feature.stamp_s == others[1].stamp_s == 7.0
