"""Registers, prescaler and pulses."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_drivers.pca9685.config import Pca9685Config, Pca9685Esc, Pca9685EscConfig, Pca9685Servo
from monstertruck_drivers.pca9685.protocol import COUNTS, count_us, counts_of, prescale, pulse, register_of


def test_the_prescaler_of_the_data_sheets_example():
    assert prescale(200.0) == 30
    assert count_us(30) * COUNTS == pytest.approx(1e6 / 200, rel=0.02)
    for frequency in (23.0, 1800.0):
        with pytest.raises(ValueError, match="needs a prescaler of"):
            prescale(frequency)


def test_registers_of_channels():
    assert [register_of(channel) for channel in (0, 1, 15)] == [0x06, 0x0A, 0x42]


@given(st.integers(0, 15), st.integers(0, COUNTS - 1))
def test_pulses_come_back(channel, counts):
    data = pulse(channel, counts)
    assert data[0] == register_of(channel)
    assert counts_of(data[1:]) == counts


def test_both_full_bits():
    assert counts_of(b"\0\x10\0\0") == COUNTS
    assert counts_of(b"\0\x10\0\x10") == 0, "off wins"
    assert counts_of(b"\x00\x08\x00\x04") == COUNTS - 1024, "the pulse goes on into the next cycle"
    with pytest.raises(ValueError, match="do not fit"):
        pulse(0, COUNTS)


@given(st.floats(-0.8, 0.8), st.sampled_from([40.0, 50.0, 60.0, 200.0]), st.floats(23e6, 27e6))
def test_a_pulse_is_right_to_half_a_count(angle, frequency, oscillator):
    config = Pca9685Config(frequency=frequency, oscillator=oscillator)
    wanted = config.front.pulse_us(angle)
    count = config.pulse_us(1)
    assert abs(config.pulse_us(config.counts(wanted)) - wanted) <= count / 2 + 1e-9


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (lambda: Pca9685Config(rear=Pca9685Servo(channel=0)), "share channel 0"),
        (lambda: Pca9685Config(frequency=330, front=Pca9685Servo(max_us=3500)), "longer than a cycle"),
        (lambda: Pca9685EscConfig(esc=Pca9685Esc(channel=0)), "a servo uses this channel"),
        (
            lambda: Pca9685EscConfig(esc=Pca9685Esc(neutral_us=2600, reach_us=1000), unit=Pca9685Config(frequency=330)),
            "longest pulse of esc",
        ),
    ],
)
def test_settings_that_do_not_fit_are_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        wrong()


def test_a_car_steers_with_its_front_axle_alone():
    config = Pca9685EscConfig(unit=Pca9685Config(rear=None, dead_time=0.02))
    assert config.steering_outputs.reaches[1] == (0.0, 0.0)
    assert config.steering_outputs.dead_time == 0.02
    assert config.motor_limits.rate == config.esc.max_rate
    assert config.battery is None
    assert config.command_timeout == config.unit.command_timeout
    assert config.stop_words == "64:1:307"
    assert Pca9685Config(rear=Pca9685Servo(channel=3)).steering_outputs.reaches[1][1] > 0.5
