"""Fuzz every reader: `python -m tests.fuzz --minutes 10` (`make fuzz`). Prints the counts as JSON."""

import argparse
import json
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fuzz.findings import CASES
from fuzz.run import run
from fuzz.small_inputs import figures
from fuzz.verdicts import compare


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, help="how long; otherwise --inputs decides")
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", default=[""], help="parts of names of kinds of input")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--verdicts", action="store_true", help="only compare readers of safetensors files")
    parser.add_argument("--small", action="store_true", help="only measure small files that claim much")
    arguments = parser.parse_args()
    if arguments.verdicts:
        verdicts = compare()
        print(json.dumps(verdicts))
        sys.exit(verdicts["reader_verdicts_differ"] > 0)
    if arguments.small:
        print(json.dumps(figures()))
        return
    report = run(
        arguments.seed, arguments.inputs, minutes=arguments.minutes, only=arguments.only, processes=arguments.processes
    )
    if not report.counts["inputs"]:
        sys.exit(f"no input was tried: is there a kind of input whose name contains {' or '.join(arguments.only)}?")
    print(f"{report.counts['inputs']} inputs tried, {len(report.findings)} findings")
    print(json.dumps(report.figures()))
    if report.findings:
        sys.exit(f"the inputs of findings are in {CASES}: mend what they show, and keep them")


if __name__ == "__main__":
    main()
