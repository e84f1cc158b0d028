"""Coverage of the 2σ intervals of `measure_sensor`, of twelve simulated sensors.

`python benchmarks/photon_transfer.py [SEEDS]` writes the table of docs/measured/photon_transfer.md.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thincam_jax.measured import measure_sensor
from thincam_jax.measured.exposures import ExposedFrames
from thincam_jax.measured.sensor import SensorCalibration

PAGE = Path(__file__).parents[1] / "docs/measured/photon_transfer.md"
SHAPE, FULL = (48, 64), 4095
TIMES = (0.005, 0.02, 0.05, 0.1, 0.2)  # s


@dataclass(frozen=True)
class Simulated:
    """A sensor: electrons, counts per electron, electrons/s; `bend`: lack of response when full."""

    name: str
    gain: float = 0.35
    read: float = 6.0
    current: float = 150.0
    rows: float = 0.0
    columns: float = 0.0
    bend: float = 0.0
    spread: float = 2.0  # of the dark levels, counts
    hot: float = 0.0
    flicker: float = 0.0
    response: float = 0.02
    frames: int = 8
    brightest: float = 0.6  # of full scale
    times: tuple[float, ...] = TIMES

    def measured(self, seed: int) -> SensorCalibration:
        """The calibration from new frames of a new sensor."""
        random = np.random.default_rng(seed)
        offset = 64.3 + self.spread * random.standard_normal(SHAPE)
        current = np.where(random.random(SHAPE) < self.hot, 5e3, self.current)
        response = 1 + self.response * random.standard_normal(SHAPE)
        light = self.brightest * FULL / self.gain / max(self.times)

        def taken(exposure, bright):
            every = []
            for _ in range(self.frames):
                lamp = 1 + self.flicker * random.standard_normal()
                mean = (bright * light * lamp * response + current) * exposure
                seen = random.poisson(mean) + self.read * random.standard_normal(SHAPE)
                seen += self.rows * random.standard_normal((SHAPE[0], 1))
                seen += self.columns * random.standard_normal(SHAPE[1])
                counts = self.gain * seen
                counts = counts * (1 - self.bend * counts / FULL)
                every.append(np.clip(np.rint(offset + counts), 0, FULL))
            return np.array(every)

        return measure_sensor(
            [ExposedFrames(one, taken(one, 1.0), taken(one, 0.0)) for one in self.times],
            full_scale=FULL,
        )


SENSORS = (
    Simulated("typical"),
    Simulated("low gain", gain=0.05, read=20.0),
    Simulated("read noise 0.25 counts", gain=0.05, read=5.0),
    Simulated("read noise 0.1 counts", gain=0.05, read=2.0),
    Simulated("and one dark level", gain=0.05, read=2.0, current=0.0, spread=0.02),
    Simulated("row noise", rows=6.0),
    Simulated("row and column noise", rows=3.0, columns=2.0),
    Simulated("2 % non-linear", bend=0.02),
    Simulated("0.5 % non-linear", bend=0.005),
    Simulated("one exposure", times=(0.1,)),
    Simulated("hot pixels, 2 % flicker", hot=2e-3, flicker=0.02),
    Simulated("5 % PRNU, three frames", response=0.05, frames=3),
)


def row(sensor: Simulated, seeds: int) -> str:
    """Coverage and bias of a sensor's gain, read noise and dark current, and its findings."""
    every = [sensor.measured(seed) for seed in range(seeds)]
    cells, truths = [], (("conversion_gain", sensor.gain), ("read_noise", sensor.read))
    for name, truth in truths:
        errors = np.array([getattr(one, f"{name}_error") for one in every])
        values = np.array([getattr(one, name) for one in every])
        covered = np.mean(np.abs(values - truth) < 2 * errors)
        cells.append(f"{covered:.0%} ({values.mean() / truth - 1:+.2%})")
    covered = []
    for one in every:
        quiet = ~one.defective & (np.abs(one.dark_rate - sensor.gain * sensor.current) < 100)
        off = np.abs(one.dark_rate - sensor.gain * sensor.current) < 2 * one.dark_rate_error
        covered.append(off[quiet].mean())
    cells.append(f"{np.mean(covered):.0%}" if len(sensor.times) > 1 else "–")
    cells.append(f"{np.mean([one.defective.sum() for one in every]):.1f}")
    said = np.mean([bool(one.findings) for one in every])
    numbers = f"{sensor.name} | {sensor.gain:g}, {sensor.read:g}, {sensor.current:g}"
    return f"| {numbers} | {' | '.join(cells)} | {said:.0%} |"


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    rows = []
    for sensor in SENSORS:
        rows.append(row(sensor, seeds))
        print(rows[-1], flush=True)
    if PAGE.exists():
        before, _, rest = PAGE.read_text("utf-8").partition("|---|---|---|---|---|---|---|\n")
        _, _, after = rest.partition("\n\n")
        head = f"{before}|---|---|---|---|---|---|---|\n"
        PAGE.write_text(head + "\n".join(rows) + "\n\n" + after, "utf-8")
