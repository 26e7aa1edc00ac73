import gc

import pytest

from airl_mav.report.run_report import YOUNG_OBJECTS, seldom_collected


@pytest.mark.parametrize("before", [(700, 10, 10), (90_000, 5, 5), (0, 10, 10)])
def test_thresholds_stand_again_afterwards(before: tuple[int, int, int]) -> None:
    kept = gc.get_threshold()
    gc.set_threshold(*before)
    try:
        with pytest.raises(ValueError, match="in between"), seldom_collected():
            # A less frequent or disabled collection is kept.
            wanted = before[0] if before[0] in (0, 90_000) else YOUNG_OBJECTS
            assert gc.get_threshold() == (wanted, *before[1:])
            raise ValueError("in between")
        assert gc.get_threshold() == before
    finally:
        gc.set_threshold(*kept)
