"""What is remembered of lamps, and what a slice of search may cost."""

import numpy as np
import pytest

from estimator.cdma.acquisition import STALE, Search
from estimator.cdma.air_interface import PROFILE_A
from estimator.cdma.code_tracking import CLEAR, FAINT, Life, Tracks
from estimator.cdma.decoder import decode, new_decoder, search
from estimator.cdma.epoch import SampleBlock

SLOT = np.array([0])


def tracked() -> Tracks:
    tracks = Tracks(PROFILE_A)
    tracks.predict(1.0)
    tracks.add(5, 17.0, 1.0, 100.0)
    tracks.life[0] = Life.CONFIRMED
    return tracks


def test_a_dark_lamp_must_be_clearly_seen_to_be_bright_again() -> None:
    tracks, between = tracked(), 0.5 * (FAINT + CLEAR)
    seen = []
    for sigmas in (between, FAINT - 1.0, between, CLEAR + 1.0, between):
        tracks.weigh(SLOT, np.array([sigmas]), np.array([1.0]))
        seen.append(bool(tracks.faint(SLOT)[0]))
    assert seen == [False, True, True, False, False]


def test_a_lamp_in_sight_is_left_alone_and_one_that_was_lost_is_put_anew_and_doubted() -> None:
    tracks = tracked()
    tracks.weigh(SLOT, np.array([50.0]), np.array([1.0]))
    tracks.add(5, 17.4, 1.0, 90.0)
    assert (tracks.phase[0], tracks.life[0], len(tracks.slots)) == (17.0, Life.CONFIRMED, 1)
    tracks.weigh(SLOT, np.array([1.0]), np.array([1.0]))
    tracks.add(5, 17.4, 1.0, 90.0)
    assert (tracks.phase[0], tracks.life[0], len(tracks.slots)) == (17.4, Life.TENTATIVE, 1)
    tracks.add(5, 60.0, 1.0, 80.0)  # far enough away to be a twin
    assert tracks.code[tracks.slots].tolist() == [5, 5]


def test_a_full_house_takes_nobody_in() -> None:
    tracks = Tracks(PROFILE_A)
    tracks.predict(1.0)
    for code in range(70):
        tracks.add(code, 1.0, 1.0, 1.0)
    assert tracks.code[tracks.slots].tolist() == list(range(64))


@pytest.mark.jit
@pytest.mark.parametrize("effort", [1, 30, 150])
def test_spectra_that_must_be_made_first_count_as_several_codes(effort: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    prepare = Search._prepare

    def counted(self: Search, codes: np.ndarray, clock: float) -> None:
        made.append(int(np.count_nonzero(np.abs(self._cache_clock[codes] - clock) > 1e-3)))
        prepare(self, codes, clock)

    decoder = new_decoder(PROFILE_A)
    monkeypatch.setattr(Search, "_prepare", counted)
    words = np.random.default_rng(0).integers(1500, 2500, 1111).astype(np.float64)
    decode(decoder, SampleBlock(1.0, 1.05, words, PROFILE_A.sample_rate))
    for _ in range(40):
        made.clear()
        search(decoder, effort)
        assert 0 < sum(made) <= max(effort // STALE, 1)
