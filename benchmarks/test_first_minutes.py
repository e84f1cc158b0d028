"""The first minutes: CPU seconds of new processes to an image, of changes after it, of a study.

`python -m pytest benchmarks/test_first_minutes.py -s`; FIRST_MINUTES=5 takes each five times and
prints medians and extremes. Every process is new; the cache of programs is a folder of its own,
empty or as the same call left it. CPU seconds are those of all threads, by `time.process_time`;
tracing is the time of a wall clock, too long where other processes run.
"""

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RUNS = int(os.environ.get("FIRST_MINUTES", "1"))

# Counts what JAX compiles and what figures take, and prints both with the CPU seconds in all.
METER = """
import json, sys, time
from thincam_jax._core.program_cache import keep_programs
keep_programs()  # as the first name of the package does, which is taken after JAX here
from jax._src import compiler
from jax import monitoring
spent = {"tracing": 0.0, "compiling": 0.0, "figures": 0.0, "programs": 0, "traces": 0}
imported = time.process_time()

def metered(module, name, part):
    function = getattr(module, name)
    def call(*arguments, **options):
        before = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            spent[part] += time.process_time() - before
            spent["programs"] += part == "compiling"
    setattr(module, name, call)

def listen(event, seconds, **_):
    if event.endswith(("jaxpr_trace_duration", "to_mlir_module_duration")):
        spent["tracing"] += seconds
        spent["traces"] += event.endswith("jaxpr_trace_duration")

metered(compiler, "backend_compile_and_load", "compiling")
monitoring.register_event_duration_secs_listener(listen)

def say(name, start=0.0):
    found = {"name": name, "in all": time.process_time() - start, **spent}
    print("METER" + json.dumps(found), flush=True)
    spent.update(dict.fromkeys(spent, 0))
"""

LINES = (
    """
import thincam_jax as tc
from thincam_jax.units import nm, um
import importlib.util, numpy as np
"""
    + METER
    + """
photo = importlib.util.find_spec("skimage").submodule_search_locations[0] + "/data/astronaut.png"
def image(solver, beta=25.0, d=6.5, distance=250.0, light=550 * nm):
    mask, sensor = tc.FresnelZoneAperture(beta=beta, width=5.6), tc.Sensor((512, 512), 11 * um)
    camera = tc.LenslessCamera(mask, sensor, distance=d)
    scene = tc.Scene.photograph(photo, distance=distance, width=180.0, wavelength=light)
    return np.asarray(tc.reconstruct(tc.record(camera, scene, noise=50.0), solver).image)
"""
)
FIRST = LINES + "image('SOLVER')\nsay('first image')\n"
CHANGES = """
changes = {"again": {}, "beta": {"beta": 24.0}, "wavelength": {"light": 520 * nm},
           "d": {"d": 6.4}, "object distance": {"distance": 240.0}}
for name, change in changes.items():
    before = time.process_time(); image("admm_tv", **change); say(name, before)
"""
# Numbers change one at a time, as far as they may before a size of the scene is another.
MANY = """
before = time.process_time(); image("admm_tv"); spent.update(dict.fromkeys(spent, 0)); each = []
for n in range(200):
    name = ("beta", "light", "d", "distance")[n % 4]
    value = {"beta": 25.0, "light": 550 * nm, "d": 6.5, "distance": 250.0}[name] * (1 - 2e-4 * n)
    before = time.process_time(); image("admm_tv", **{name: value})
    each.append(time.process_time() - before)
for name, seconds in ("slowest of 200 changes", max(each)), ("median", sorted(each)[100]):
    print("METER" + json.dumps({"name": name, "in all": seconds, **spent}), flush=True)
"""
STUDY = (
    METER
    + """
from thincam_jax.commands import start
import thincam_jax.plot.frame as frame
metered(frame, "as_png", "figures")
sys.argv[1:] = ["run", "configs/STUDY.yaml", "--out", sys.argv[1] + "/run"]
try:
    start.main()
finally:
    say("report")
"""
)
NUMPY = """
import json, sys, time; sys.path.insert(0, "benchmarks")
import numpy as np, others
c, p = np.random.default_rng(0).random((2, 512, 512)).astype(np.float32)
for _ in range(3):  # colours
    others.numpy_admm(c, p, others.penalties(1e-4, 1e-5), 100)
print("METER" + json.dumps({"name": "first image", "in all": time.process_time()}))
"""
CASES = {
    "three lines, admm_tv": FIRST.replace("SOLVER", "admm_tv"),
    "three lines, pnp": FIRST.replace("SOLVER", "pnp"),
    "changes after the first image": FIRST.replace("SOLVER", "admm_tv") + CHANGES,
    "200 changes at 128²": LINES.replace("(512, 512), 11 *", "(128, 128), 44 *") + MANY,
    "quick.yaml": STUDY.replace("STUDY", "quick"),
    "make run": STUDY.replace("STUDY", "fza_superresolution"),
    "NumPy ADMM, 3 colours, 100 iterations": NUMPY,
}


def call(code, folder, cache):
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "THINCAM_"))}
    path = os.pathsep.join([str(ROOT), kept.get("PYTHONPATH", "")])
    own = {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)],
        capture_output=True,
        text=True,
        env=kept | own,
        cwd=ROOT,
        timeout=1800,
    )
    found = [json.loads(x[5:]) for x in done.stdout.splitlines() if x.startswith("METER")]
    assert found, done.stderr[-2000:]
    return found


@pytest.mark.parametrize("name", CASES)
def test_first_minutes(name, tmp_path, capsys):
    """CPU seconds with an empty cache of programs, then with what the first process kept."""
    rows = {}
    for run in range(RUNS):
        for state in ("empty", "kept"):
            folder = tmp_path / f"{run}{state}"
            folder.mkdir()
            for found in call(CASES[name], folder, tmp_path / f"cache{run}"):
                rows.setdefault((found.pop("name"), state), []).append(found)
    with capsys.disabled():
        columns = ("in all", "tracing", "compiling", "figures", "programs", "traces")
        print(f"\n{name}\n| step | cache |", " | ".join(columns), "|")
        for (step, state), values in rows.items():
            print(f"| {step} | {state} |", " | ".join(spread(values, k) for k in columns), "|")


def spread(values, key):
    """Median, and least and most of several."""
    numbers = [v.get(key, 0) for v in values]
    extremes = f" ({min(numbers):.3g}–{max(numbers):.3g})" if len(numbers) > 1 else ""
    return f"{statistics.median(numbers):.3g}{extremes}"
