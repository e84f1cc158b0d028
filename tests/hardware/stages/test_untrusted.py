"""What comes over the wire is not trusted: mutated messages, and faults at random moments."""

import random
import resource
from contextlib import suppress
from itertools import product

import pytest
from stage_faults import RIGHT, STAGES, campaign

from thincam_jax.hardware.base import ProtocolError
from thincam_jax.hardware.stages.grbl import parse_line
from thincam_jax.hardware.stages.zaber import checksum, parse_message
from thincam_jax.hardware.virtual.zaber import parse_command

SEEDS = {
    parse_message: [
        b"@01 1 07 OK BUSY -- 0:E0", b"@01 0 OK IDLE WR 7.38", b"@01 1 99 RJ IDLE FS BADDATA",
        b"!01 1 IDLE --", b"#01 0 help text", b"@01 1 12 OK IDLE WR 02 WR NC",
    ],
    parse_command: [b"/1 1 07 move abs 1000:E9", b"/get pos", b"/", b"/0 0 00 warnings clear"],
    parse_line: [
        b"ok", b"error:11", b"ALARM:1", b"Grbl 1.1h ['$' for help]", b"$130=200.000",
        b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", b">G20:ok", b"<Hold:1|MPos:0.0,0.0|Pn:X>",
        b"<Idle|MPos:0.000,-3.500,10.250|FS:0,0|WCO:0.000,1.000,2.000>",
    ],
}  # fmt: skip
PARSERS = pytest.mark.parametrize("parser", SEEDS, ids=lambda parser: parser.__name__)
STRAY = (*b"\x00 \xff : | - . ,".split(), b" ", b"9" * 30, b"e9", b"@01 1 ", b"A" * 600)


def mutated(line: bytes, random_: random.Random) -> bytes:
    """A message with a few bytes changed, put in, left out, repeated or cut off."""
    for _ in range(random_.randrange(4)):
        at, kind = random_.randrange(len(line) + 1), random_.randrange(5)
        if kind == 0:
            line = line[:at] + bytes([random_.randrange(256)]) + line[at + 1 :]
        elif kind == 1:
            line = line[:at] + random_.choice(STRAY) + line[at:]
        elif kind == 2:
            line = line[:at] + line[at + random_.randrange(1, 5) :]
        elif kind == 3:
            line = line[:at] + line[at - 8 if at > 8 else 0 :]
        else:
            line = line[:at]
    if random_.random() < 0.3:  # a checksum that fits leads further in
        line += b":%02X" % checksum(line[1:])
    return line


def feed(parser, times: int, seed: int) -> int:
    """Feeds a parser; returns how many it took for messages. It may raise ProtocolError alone."""
    random_, taken = random.Random(seed), 0
    for _ in range(times):
        line = mutated(random_.choice(SEEDS[parser]), random_)
        try:
            taken += parser(line) is not None
        except ProtocolError as error:
            assert len(str(error)) < 1000
    return taken


@PARSERS
def test_no_repetition_is_tried_in_all_ways(parser):
    parts = (b"|a:b", b" ", b"a:", b" (", b"0", b"0.0,", b"@01 1 ", b"/1 ")
    ends = (b"", b">", b"]", b":00", b")", b"\xff")
    for start, part, end in product({line[:6] for line in SEEDS[parser]}, parts, ends):
        with suppress(ProtocolError):  # a hang is what this looks for
            parser(start + part * (400 // len(part)) + end)


@PARSERS
@pytest.mark.parametrize("times", [2_000, pytest.param(1_000_000, marks=pytest.mark.thorough)])
def test_mutated_messages_are_messages_or_protocol_errors(parser, times):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    taken = feed(parser, times, seed=1)
    assert 0.1 * times < taken < 0.95 * times  # neither all nor none, so both ways are tried
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


@pytest.mark.parametrize("times", [5, pytest.param(100, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("fault", RIGHT)
@pytest.mark.parametrize("stage", STAGES)
def test_a_fault_is_recovered_or_reported_and_no_position_is_wrong(stage, fault, times):
    counts = campaign(stage, fault, times)
    assert counts.injected == times == counts.recovered + counts.stopped.total()
    assert not counts.wrong_errors and counts.wrong_positions == 0
