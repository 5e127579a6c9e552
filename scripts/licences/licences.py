"""The page of licences: what each locked package states, as SPDX expressions."""

from __future__ import annotations

import importlib.metadata
import json
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "licences.md"
RECORDED: dict[str, str] = json.loads(Path(__file__).with_name("recorded.json").read_text(encoding="utf-8"))["licences"]
UNKNOWN = "unknown"
ALLOWED = frozenset({"0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "GPL-3.0-or-later", "ISC"}) | {
    "LLVM-exception",
    "MIT",
    "MIT-CMU",
    "MPL-2.0",
    "PSF-2.0",
    "Zlib",
}
"""SPDX identifiers that any dependency may have: free, and compatible with the GPL 3."""
EXCEPTIONS = {
    "LicenseRef-NVIDIA-Proprietary": (r"nvidia-.+", "proprietary; parts of torch's CUDA build"),
    "LicenseRef-matplotlib": (r"matplotlib", "free, modelled on Python's; draws figures of benchmarks"),
    "CNRI-Python": (r"regex", "free, of Python 1.6; required by `diffusers` alone, which tests compare with"),
    "LicenseRef-SMPL-X": (r"smplx", "non-commercial research only; tests alone import it, to compare the body model"),
    UNKNOWN: (r"cuda-toolkit", "its metadata states none; it has no files, and requires NVIDIA's packages"),
}
"""Other licences: a pattern of the packages that may have them, and what they are."""
INTRODUCTION = """\
# Licences of dependencies

Every package of `requirements.lock`, `requirements52.lock`, `requirements53.lock` and the extension's locks in
`blender_primdiffusion/requirements/`, with the licence that its metadata state. `python scripts/licences` writes this
page. The extension's zip contains none of these packages: *Set Up Backend* lets pip download those marked in the last
column. Tests, training and tools use the others. Compiled libraries inside a wheel may have licences of their own,
which its `.dist-info` folder holds.
"""

_PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s+]+)", re.MULTILINE)
_STATED = {
    "apache": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "apache 2.0 license": "Apache-2.0",
    "bsd 2-clause license": "BSD-2-Clause",
    "3-clause bsd license": "BSD-3-Clause",
    "gpl-3.0": "GPL-3.0-or-later",
}
"""What packages write in their field License where it is no SPDX identifier."""
_CLASSIFIERS = {
    "Apache Software License": "Apache-2.0",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
}
_TEXTS = (
    (r"MIT License|Permission is hereby granted, free of charge", "MIT"),
    (r"License: BSD-3-Clause", "BSD-3-Clause"),
    (r"Apache License\s+Version 2\.0", "Apache-2.0"),
    (r"matplotlib versions 1\.3\.0 and later", "LicenseRef-matplotlib"),
    (r"Redistribution and use[\s\S]{,1500}(?:[Nn]either the names? of|[Tt]he names? of the)", "BSD-3-Clause"),
    (r"Redistribution and use", "BSD-2-Clause"),
)
"""Phrases of licences; the one that comes first in a text counts, as texts of bundled libraries follow."""


def page() -> str:
    """The text of docs/licences.md."""
    pins = locked()
    licences = {name: licence_of(name, versions) for name, (versions, _) in pins.items()}
    exceptions = []
    for licence, (_, reason) in EXCEPTIONS.items():
        names = sorted(name for name in pins if licence in licences[name].split(" AND "))
        exceptions.append(f"- {licence}: {', '.join(f'`{name}`' for name in names)}; {reason}.")
    rows = [
        f"| {name} | {', '.join(sorted(versions))} | {licences[name]} | {'yes' if backend else ''} |"
        for name, (versions, backend) in sorted(pins.items())
    ]
    return "\n".join(
        [
            INTRODUCTION,
            f"Allowed for any package: {', '.join(sorted(ALLOWED))}.",
            "Exceptions:",
            "",
            *exceptions,
            "",
            "| package | version | licence (SPDX) | set-up installs it |",
            "|---|---|---|---|",
            *rows,
            "",
        ]
    )


def locked() -> dict[str, tuple[set[str], bool]]:
    """Every package of every lock, by normalised name: its versions, and whether the extension's set-up installs it."""
    versions: defaultdict[str, set[str]] = defaultdict(set)
    backend: set[str] = set()
    for lock in (ROOT / "blender_primdiffusion" / "requirements").glob("*.txt"):
        for name, version in _PIN.findall(lock.read_text(encoding="utf-8")):
            versions[name].add(version)
            backend.add(name)
    for lock in (ROOT / "requirements.lock", ROOT / "requirements52.lock", ROOT / "requirements53.lock"):
        for name, version in _PIN.findall(lock.read_text(encoding="utf-8")):
            versions[re.sub(r"[-_.]+", "-", name).lower()].add(version)
    return {name: (found, name in backend) for name, found in versions.items()}


def licence_of(name: str, versions: set[str]) -> str:
    """The licence of a package as an SPDX expression: recorded for these versions, or stated by the installed package.

    UNKNOWN where neither is so, also if another version is installed than any of the locked ones.
    """
    recorded = {RECORDED.get(f"{name}=={version}", UNKNOWN) for version in versions}
    if recorded != {UNKNOWN}:
        return recorded.pop() if len(recorded) == 1 else UNKNOWN
    try:
        distribution = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return UNKNOWN
    return stated_licence(distribution) if distribution.version.split("+")[0] in versions else UNKNOWN


def stated_licence(distribution: importlib.metadata.Distribution) -> str:
    """What a package's metadata say of its licence: expression, field, classifier, or the texts of licence files."""
    metadata = distribution.metadata
    if "License-Expression" in metadata:
        return metadata["License-Expression"]
    stated = metadata.get("License", "").strip()
    if set(re.split(" AND | OR | WITH ", stated)) <= ALLOWED:
        return stated
    if stated.lower() in _STATED:
        return _STATED[stated.lower()]
    classifiers = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or []]
    known = [_CLASSIFIERS[classifier] for classifier in classifiers if classifier in _CLASSIFIERS]
    if len(known) == 1:
        return known[0]
    names = [file for file in distribution.files or () if ".dist-info" in file.parts[0]]
    files = [file.read_text("utf-8") for file in names if re.match(r"(?i)licen[cs]e|copying", file.name)]
    return next((found for text in (stated, *files) if (found := _of_text(text)) != UNKNOWN), UNKNOWN)


def rejected(name: str, licence: str) -> bool:
    """Whether an SPDX expression of this package needs a licence that is neither allowed nor its exception."""
    for part in licence.split(" AND "):
        free = any(set(side.split(" WITH ")) <= ALLOWED for side in part.strip("() ").split(" OR "))
        if not free and not (part in EXCEPTIONS and re.fullmatch(EXCEPTIONS[part][0], name)):
            return True
    return False


def _of_text(text: str) -> str:
    found = [(match.start(), identifier) for phrase, identifier in _TEXTS if (match := re.search(phrase, text))]
    return min(found, key=lambda pair: pair[0])[1] if found else UNKNOWN
