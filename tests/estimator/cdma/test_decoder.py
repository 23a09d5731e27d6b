"""The whole decoder in front of a simulated ceiling."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.cdma.air_interface import PROFILE_A, PROFILE_B, PROFILE_D, PROFILES, Profile
from estimator.cdma.data_frame import LampFrame
from estimator.cdma.decoder import decode, new_decoder, search
from estimator.cdma.epoch import BlockFlag, LinkFlag, SampleBlock
from tests.estimator.cdma_scene import Run, ceiling, currents, sampled
from tools.sim.light.waveform import Ambient

pytestmark = pytest.mark.jit


def rms(run: Run, count: int = 25) -> np.ndarray:
    errors = np.array([run.errors(block, epoch) for block, epoch in run.blocks(count)])
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


def test_sixteen_lamps_with_data_and_flicker() -> None:
    run = Run(ceiling(1, currents(4.6, 5.3)))
    run.settle(20)
    relative = rms(run, 40)
    assert relative[0] < 1.0e-3
    assert relative[7] < 3.0e-3


def test_variances_are_honest() -> None:
    run = Run(ceiling(2))
    run.settle(20)
    z = []
    for block, epoch in run.blocks(40):
        order = [run.codes().index(code) for code in epoch.ids]
        z.append((epoch.amplitude - block.truth_a[order]) / np.sqrt(epoch.variance))
    assert np.std(z) == pytest.approx(1.0, abs=0.15)


def test_bright_day_costs_less_than_twofold() -> None:
    dull, bright = Run(ceiling(3)), Run(ceiling(3))
    bright.ceiling.ambient = Ambient(current_a=1580e-6, flicker_a=15.8e-6)
    for run in (dull, bright):
        run.settle(20)
    assert rms(bright)[0] < 2.0 * max(rms(dull)[0], 3e-4)


@pytest.mark.parametrize("seed", range(6))
def test_from_cold_in_a_quarter_second(seed: int) -> None:
    run = Run(ceiling(20 + seed, scl_error=np.linspace(-2e-4, 2e-4, 6)[seed]))
    epoch = run.settle(5)
    assert sorted(epoch.ids) == sorted(run.codes())


@pytest.mark.parametrize("scl_error", [0.01, -0.0093, 0.0007])
def test_an_unknown_clock_is_found_and_kept(scl_error: float) -> None:
    run = Run(ceiling(30, currents(4.6, 5.3)[:6], scl_error=scl_error), clock_ppm=None)
    assert run.decoder.clock_ppm is None
    epoch = run.settle(50)
    assert sorted(epoch.ids) == sorted(run.codes())
    true_ppm = 1e6 * (1.0 / (1.0 + scl_error) - 1.0)
    assert epoch.clock_ppm == pytest.approx(true_ppm, abs=60.0)
    again = Run(run.ceiling, clock_ppm=epoch.clock_ppm, t=run.t)
    assert sorted(again.settle(5).ids) == sorted(run.codes())


def test_a_stored_clock_that_is_wrong_is_given_up() -> None:
    run = Run(ceiling(31, currents(4.6, 5.3)[:6], scl_error=0.006), clock_ppm=0.0)
    epoch = run.settle(60)
    assert sorted(epoch.ids) == sorted(run.codes())
    assert epoch.clock_ppm == pytest.approx(-5964.0, abs=60.0)


def test_lamps_describe_themselves_within_one_frame_and_little_more() -> None:
    run = Run(ceiling(5, currents(4.6, 5.3)[:8]))
    epoch = run.settle(72)  # 3.6 s
    lamps = {lamp.code: lamp for lamp in run.ceiling.lamps}
    assert len(epoch.ids) == 8
    known = [(code, frame) for code, frame in zip(epoch.ids.tolist(), epoch.lamps, strict=True) if frame]
    assert len(known) >= 7
    for code, frame in known:
        x, y, z = lamps[code].position_m
        assert frame == LampFrame(code + 1000, pytest.approx(x), pytest.approx(y), pytest.approx(z), 1.5, 70.0)  # type: ignore[arg-type]  # approx stands for a float


def test_no_lamp_no_id_however_long_one_looks() -> None:
    run = Run(ceiling(6, np.array([])))
    for _, epoch in run.blocks(150):
        assert len(epoch.ids) == 0
        assert epoch.clock_ppm == 0.0


def test_no_false_id_while_lamps_come_and_go() -> None:
    world = ceiling(7)
    everything, rng, seen = list(world.lamps), np.random.default_rng(7), set()
    run = Run(world)
    for _ in range(20):
        world.lamps = [lamp for lamp in everything if rng.random() < 0.6]
        for _, epoch in run.blocks(6):
            seen |= set(epoch.ids.tolist())
    assert seen == {lamp.code for lamp in everything}


def test_near_and_far() -> None:
    run = Run(ceiling(8, np.array([2.79e-6, 0.1e-6, 0.04e-6])))
    assert sorted(run.settle(10).ids) == sorted(run.codes())
    assert rms(run)[1] < 0.02


def test_an_occluded_lamp_fades_comes_back_at_once_and_is_given_up_in_the_end() -> None:
    world = ceiling(9, currents(4.6, 5.3)[:6])
    run, lamp = Run(world), world.lamps[1]
    run.settle(20)
    dark = [replace(x, current_a=0.0) if x is lamp else x for x in world.lamps]
    bright, world.lamps = world.lamps, dark
    epoch = run.settle(10)
    at = epoch.ids.tolist().index(lamp.code)
    assert epoch.flags[at] == LinkFlag.FAINT
    assert epoch.amplitude[at] < 5 * np.sqrt(epoch.variance[at]) < 5e-9
    world.lamps = bright
    block, epoch = run.block()
    assert abs(run.errors(block, epoch)[1]) < 0.01
    world.lamps = dark
    assert lamp.code not in run.settle(25).ids


def test_two_lamps_with_one_code() -> None:
    world = ceiling(10, np.array([2e-6, 1.5e-6, 1e-6]))
    twin = world.lamps[2]
    world.lamps.append(replace(twin, current_a=0.8e-6, phase_chips=twin.phase_chips + 40.3, ppm=twin.ppm + 7.0))
    run = Run(world)
    epoch = run.settle(15)
    at = [k for k, code in enumerate(epoch.ids.tolist()) if code == twin.code]
    assert len(at) == 2
    assert all(epoch.flags[k] == LinkFlag.TWIN for k in at)
    np.testing.assert_allclose(sorted(epoch.amplitude[at]), [0.24e-6, 0.3e-6], rtol=0.01)
    assert np.count_nonzero(epoch.flags) == 2


def test_sixty_four_lamps() -> None:
    row = 1.2 * (np.arange(8) - 3.5)
    r2 = (row[:, None] ** 2 + row**2).ravel()
    run = Run(ceiling(11, 2.79e-6 * (2.6**2 / (r2 + 2.6**2)) ** 1.823))
    epoch = run.settle(30)
    assert sorted(epoch.ids) == sorted(run.codes())
    strongest = int(np.argmax([lamp.current_a for lamp in run.ceiling.lamps]))
    assert rms(run, 10)[strongest] < 2e-3


@pytest.mark.parametrize(("profile", "lamps", "blocks", "worst"), [(PROFILE_B, 8, 40, 0.02), (PROFILE_D, 16, 10, 1e-3)])
def test_other_profiles(profile: Profile, lamps: int, blocks: int, worst: float) -> None:
    world = ceiling(12, currents(4.6, 5.3)[:lamps], profile=profile)
    run = Run(world, profile, samples=int(profile.epoch_s * profile.sample_rate), slices=4)
    assert sorted(run.settle(blocks).ids) == sorted(run.codes())
    assert rms(run, 12)[0] < worst


def test_a_moving_robot() -> None:
    world = ceiling(13)
    world.lamps = [
        replace(lamp, slope_a_s=0.5 * lamp.current_a * (-1) ** k, current_a=lamp.current_a * (1 - 1.0 * (-1) ** k))
        for k, lamp in enumerate(world.lamps)
    ]
    world.lamps = [replace(lamp, current_a=abs(lamp.current_a) + 0.2e-6) for lamp in world.lamps]
    run = Run(world)
    run.settle(20)
    assert np.nanmax(rms(run, 10)[:4]) < 5e-3


def test_late_time_stamps_move_no_lamp() -> None:
    run, rng = Run(ceiling(14)), np.random.default_rng(0)
    run.settle(20)
    for k in range(30):
        block = run.ceiling.block(run.t, run.samples)
        late = float(rng.exponential(1e-3)) if k % 3 == 0 else 0.0
        run.t = block.t1 + late + 5e-4
        epoch = decode(run.decoder, SampleBlock(block.t0, block.t1 + late, block.words, block.nominal_rate))
        assert epoch.block == BlockFlag.NONE
        assert np.nanmax(np.abs(run.errors(block, epoch)[:8])) < 0.01


@pytest.mark.parametrize("chips", [0.5, -0.5, 0.8, -1.3, 40.0])
def test_a_lamp_that_is_followed_at_a_wrong_phase_is_found_again(chips: float) -> None:
    run = Run(ceiling(21, currents(4.6, 5.3)[:8]))
    run.settle(20)
    run.decoder.tracks.phase[int(np.argmax(run.decoder.tracks.amplitude))] += chips
    run.settle(8)
    block, epoch = run.block()
    assert np.nanmax(np.abs(run.errors(block, epoch))) < 0.02
    bright = epoch.ids[epoch.flags & LinkFlag.FAINT == 0]
    assert sorted(bright) == sorted(run.codes())
    run.settle(25)
    assert run.block()[1].flags.sum() == 0


def test_a_host_clock_that_lost_time_is_survived() -> None:
    run = Run(ceiling(22, currents(4.6, 5.3)[:8]))
    run.settle(30)
    run.decoder.tracks.phase += 1234.5
    run.settle(30)
    _, epoch = run.block()
    assert sorted(epoch.ids) == sorted(run.codes())
    assert epoch.flags.sum() == 0


def test_pauses_short_and_long() -> None:
    run = Run(ceiling(15, currents(4.6, 5.3)[:8]))
    run.settle(40)
    run.t += 5.0
    block, epoch = run.block()
    assert sorted(epoch.ids) == sorted(run.codes())
    assert np.nanmax(np.abs(run.errors(block, epoch))) < 0.02
    run.t += 7200.0
    run.block()
    assert sorted(run.settle(8).ids) == sorted(run.codes())


def test_blocks_of_other_lengths() -> None:
    run = Run(ceiling(16, currents(4.6, 5.3)[:6]))
    run.settle(10)
    for samples in (700, 2048, 1111, 4096):
        run.samples = samples
        assert sorted(run.settle(3).ids) == sorted(run.codes())
        assert rms(run, 5)[0] < 3e-3


def test_clipped_samples_are_left_out() -> None:
    run = Run(ceiling(17))
    run.settle(20)
    block = run.ceiling.block(run.t, run.samples)
    words = block.words.copy()
    words[200:260], words[700:720] = 4095.0, 0.0
    epoch = decode(run.decoder, SampleBlock(block.t0, block.t1, words, block.nominal_rate))
    assert epoch.block == BlockFlag.CLIPPED
    assert np.nanmax(np.abs(run.errors(block, epoch)[:8])) < 0.01


@pytest.mark.parametrize("short_of_rail", [0.0, 16.0])
def test_an_amplifier_that_stops_short_of_its_rails(short_of_rail: float) -> None:
    """Flicker of 26 uA in a range of +-25 uA: a tenth of the samples stand where the amplifier stops."""
    run = Run(ceiling(17))
    run.settle(20)
    run.ceiling.ambient = Ambient(flicker_a=26e-6)
    block = run.ceiling.block(run.t, run.samples)
    words = np.clip(block.words, short_of_rail, 4095.0 - short_of_rail)
    epoch = decode(run.decoder, SampleBlock(block.t0, block.t1, words, block.nominal_rate))
    assert epoch.block == BlockFlag.CLIPPED
    assert np.nanmax(np.abs(run.errors(block, epoch)[:8])) < 0.01


@pytest.mark.parametrize(
    ("damage", "flag"),
    [
        (lambda w: np.full_like(w, 2048.0), BlockFlag.FLAT),
        (lambda w: np.where(np.arange(len(w)) < 400, 4095.0, w), BlockFlag.SATURATED),
        (lambda w: np.where(np.arange(len(w)) == 5, 0xF123, w), BlockFlag.MALFORMED),
        (lambda w: np.where(np.arange(len(w)) == 5, np.nan, w), BlockFlag.MALFORMED),
        (lambda w: w - 3000.0, BlockFlag.MALFORMED),
        (lambda w: w[:500], BlockFlag.LENGTH),
        (lambda w: w[:0], BlockFlag.LENGTH),
        (lambda w: np.tile(w, 6), BlockFlag.LENGTH),
    ],
)
def test_a_bad_block_is_named_and_does_no_harm(damage: object, flag: BlockFlag) -> None:
    run = Run(ceiling(18, currents(4.6, 5.3)[:6]))
    run.settle(12)
    block = run.ceiling.block(run.t, run.samples)
    words = damage(block.words)  # type: ignore[operator]  # parametrize has no types
    epoch = decode(run.decoder, SampleBlock(block.t0, block.t1, words, block.nominal_rate))
    assert epoch.block == flag
    assert len(epoch.ids) == len(epoch.amplitude) == len(epoch.lamps) == 0
    run.t = block.t1 + 5e-4
    block, epoch = run.block()
    assert epoch.block == BlockFlag.NONE
    assert np.nanmax(np.abs(run.errors(block, epoch))) < 0.02


@pytest.mark.parametrize(("t1", "rate"), [(0.9, 22222.0), (1.05, 0.0), (1.05, -1.0)])
def test_impossible_times_are_malformed(t1: float, rate: float) -> None:
    epoch = decode(new_decoder(PROFILE_A), SampleBlock(1.0, t1, np.arange(1111.0), rate))
    assert epoch.block == BlockFlag.MALFORMED


def test_a_time_stamp_far_off_before_late_ones_does_no_harm() -> None:
    run = Run(ceiling(18, currents(4.6, 5.3)[:4]))
    run.settle(12)
    for k in range(20):
        block = run.ceiling.block(run.t, run.samples)
        run.t = block.t1 + 2e-3
        end = block.t1 + 400e-6 if k else block.t0 + 1e-6
        epoch = decode(run.decoder, SampleBlock(block.t0, end, block.words, block.nominal_rate))
    assert sorted(epoch.ids) == sorted(run.codes())


def test_a_nominal_rate_beside_that_of_the_profile() -> None:
    run = Run(ceiling(18, currents(4.6, 5.3)[:4]), clock_ppm=None)
    for _ in range(40):
        block = run.ceiling.block(run.t, run.samples)
        run.t = block.t1 + 1e-3
        epoch = decode(run.decoder, SampleBlock(block.t0, block.t1, block.words, 1.005 * block.nominal_rate))
        search(run.decoder, 600)
    assert sorted(epoch.ids) == sorted(run.codes())


def test_the_same_words_give_the_same_answer() -> None:
    world = ceiling(19)
    blocks = [sampled(world.block(1.0 + 0.0508 * k, 1111)) for k in range(12)]
    answers = []
    for _ in range(2):
        decoder = new_decoder(PROFILE_A, 0.0)
        for block in blocks:
            epoch = decode(decoder, block)
            search(decoder, 129)
        answers.append(epoch)
    np.testing.assert_array_equal(answers[0].amplitude, answers[1].amplitude)
    np.testing.assert_array_equal(answers[0].ids, answers[1].ids)


def test_slices_of_any_size_find_the_same_lamps() -> None:
    for codes in (17, 43, 129):
        run = Run(ceiling(20, currents(4.6, 5.3)[:5]), slices=0)
        for _ in range(12):
            run.block()
            for _ in range(-(-300 // codes)):
                search(run.decoder, codes)
        _, epoch = run.block()
        assert sorted(epoch.ids) == sorted(run.codes())


def test_a_stored_clock_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"clock_ppm = 25000 is outside \+-10000: delete the stored value"):
        new_decoder(PROFILE_A, 25000)
    with pytest.raises(ValueError, match="clock_ppm = nan"):
        new_decoder(PROFILE_A, float("nan"))


def test_profiles_by_name() -> None:
    assert {name: profile.length for name, profile in PROFILES.items()} == {"A": 127, "B": 63, "D": 511}
    assert PROFILE_A.period_s == pytest.approx(25.4e-3)
