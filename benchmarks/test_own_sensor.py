"""Design for three own sensors: distance from the best, seconds and memory.

`nice -n 5 python -m pytest benchmarks/test_own_sensor.py -s`. Each design is a new process with an
empty cache of programs: CPU seconds of all threads and the wall clock from before the import to the
printed result, and the largest resident memory. The best is that of an exhaustive grid of 30 points
a side over the same bounds, whose twelve best points apart are improved by the same simplex, some
minutes; gains of all designs over the thesis' pair are by even samples that resolve every fringe
(EXACT=0 leaves these out, which take gigabytes for 12 million pixels).
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import thincam_jax as tc
from thincam_jax.design.landscape import evaluate_grid
from thincam_jax.design.problem import _exact_count
from thincam_jax.design.search import best_apart, evaluate, improved
from thincam_jax.design.setup import Quadrant

ROOT = Path(__file__).parents[1]
SENSORS = {"375x500, 11 um": (375, 500, 11e-3), "1500x2000, 3.45 um": (1500, 2000, 3.45e-3)}
SENSORS["3000x4000, 1.55 um"] = (3000, 4000, 1.55e-3)
FRESH = """
import json, resource, sys, time
start = time.perf_counter()
import thincam_jax as tc
rows, columns, pitch = json.loads(sys.argv[1])
print(tc.design.for_sensor(tc.Sensor((rows, columns), pitch)), file=sys.stderr)
used = resource.getrusage(resource.RUSAGE_SELF)
with open("/proc/self/status") as status:  # ru_maxrss has the parent's, too
    most = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
print(json.dumps([used.ru_utime + used.ru_stime, time.perf_counter() - start, most]))
"""


@pytest.mark.parametrize("name", SENSORS)
def test_own_sensor(name, tmp_path):
    given = SENSORS[name]
    unset = "JAX_", "THINCAM_", "XLA_"
    surroundings = {k: text for k, text in os.environ.items() if not k.startswith(unset)}
    surroundings |= {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = (sys.executable, "-c", FRESH, json.dumps(given))
    done = subprocess.run(command, capture_output=True, text=True, env=surroundings, check=True)
    cpu, wall, memory = json.loads(done.stdout)
    print(f"\n{name}: {cpu:.1f} CPU seconds, {wall:.1f} s, {memory / 2**20:.2f} GiB\n{done.stderr}")
    found = tc.design.for_sensor(tc.Sensor(given[:2], given[2]))
    problem, start = found.problem, time.perf_counter()
    with jax.enable_x64(True):
        points, costs = evaluate_grid(problem.objective, problem.space, problem.data, 30)
        chosen = np.asarray(points)[best_apart(np.asarray(points), np.asarray(costs), 12)]
        better, _ = improved(problem, chosen[::-1], ["converged"] * 11)
        best = min(better, key=lambda one: one.objective)
        error = 10 * np.log10(best.objective)
        print(
            f"grid and 12 simplexes: {error:.3f} dB at {np.asarray(best.values).round(2)}, "
            f"{found.errors_db[0] - error:+.3f} dB found, {time.perf_counter() - start:.0f} s"
        )
        if os.environ.get("EXACT", "1") == "1":
            print(*exact_errors(found, best), "dB: found, thesis, random, grid")


def exact_errors(found, best):
    """Errors in dB by even samples that resolve every fringe."""
    problem, space = found.problem, found.problem.space
    highest = problem.exact.frequencies.highest
    count = _exact_count(space, problem.exact.setup, float(highest))
    resolved = replace(problem.exact, frequencies=Quadrant(highest, count))
    designs = found.best.design, space.base, found.random, best.design
    points = jax.numpy.stack([space.point(one) for one in designs])
    errors = evaluate(problem.objective, space, resolved, points, at_a_time=1)
    return [f"{10 * np.log10(float(error)):.3f}" for error in errors]
