"""Two processes that write results of several files into one folder at once: how often files of two results are mixed.

`python tests/backend/two_writers.py --rounds 25` prints a line of JSON with `two_writers_mixed`.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

FILES = 8
"""Of each result."""
WRITER = f"""
import sys
from pathlib import Path
from primdiffusion.files.whole_files import staged
print("ready", flush=True)
for line in sys.stdin:
    with staged(Path(line.strip())) as folder:
        for number in range({FILES}):
            (folder / str(number)).write_text(sys.argv[1])
    print("done", flush=True)
"""


def mixed(rounds: int, place: Path) -> int:
    """Let two processes write into a new folder in `place` in each round; return the rounds that left a mixture."""
    pipe = subprocess.PIPE
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, name], stdin=pipe, stdout=pipe, text=True) for name in "ab"
    ]
    found = 0
    try:
        for number in range(rounds + 1):
            for writer in writers:
                assert writer.stdout.readline().strip() == ("done" if number else "ready")
            if number:
                contents = [path.read_text() for path in (place / str(number - 1)).iterdir()]
                assert len(contents) == FILES
                found += len(set(contents)) > 1
            if number < rounds:
                (place / str(number)).mkdir()
                for writer in writers:
                    writer.stdin.write(f"{place / str(number)}\n")
                    writer.stdin.flush()
    finally:
        for writer in writers:
            writer.communicate()
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=200)
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps({"two_writers_mixed": mixed(parser.parse_args().rounds, Path(folder))}))
