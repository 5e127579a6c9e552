"""A renderer for tests: views are small files; it can be told to kill itself or its worker once, or to fail."""

import os
import signal
import sys
import time
from pathlib import Path

out, arguments = Path(sys.argv[1]), sys.argv[2:]
subjects = ["anna", "bert", "carl", "dora"]
if "--list" in arguments:
    print("A renderer's own words")
    print("\n".join(f'PRIMDIFFUSION {{"line": "{name}"}}' for name in subjects))
    sys.exit()
subject = arguments[arguments.index("--only") + 1]
folder = out / subject
folder.mkdir(parents=True, exist_ok=True)
for view in range(6):
    path = folder / f"view{view}"
    if path.exists():
        continue
    trouble = out / f"{subject}.{view}.trouble"
    if trouble.exists():
        what = trouble.read_text()
        trouble.unlink()
        if what == "fail":
            sys.exit("anna has no texture")
        os.kill(os.getppid() if what == "kill worker" else os.getpid(), signal.SIGKILL)
        time.sleep(5)
    time.sleep(0.05)
    with (out / "log").open("a") as log:
        log.write(f"{subject} {view}\n")
    path.touch()
