"""Seals: keys that nobody knows, published as hashes before anything is run.

    keys = new_keys(600)                       # secret, until each row of the table reveals its own
    seals_text(keys)                           # to be committed, alone, before the run
    trial_key(commit, keys[7], 7)              # what trial 7 is drawn from

A trial is drawn from the hash of the commit that published the seals and from its own key. Whoever
runs the trials cannot choose them: the keys are fixed before the commit's hash exists, and the
hash is fixed before any trial can be drawn. The tool cannot draw its trial: it has no key.
"""

import hashlib
import secrets
import subprocess
from pathlib import Path


class SealError(ValueError):
    """A table, a seal or a history that does not fit. One line: which, why, what to do."""


def new_keys(count):
    """`count` random keys, hex."""
    return [secrets.token_hex(16) for _ in range(count)]


def seal(key):
    """SHA-256 of a key, hex."""
    return hashlib.sha256(key.encode()).hexdigest()


def seals_text(keys):
    """The file to publish: "number seal" a line."""
    return "".join(f"{number} {seal(key)}\n" for number, key in enumerate(keys))


def read_pairs(text):
    """{number: hex} of a file of seals or of keys. Raises SealError."""
    try:
        rows = [line.split() for line in text.splitlines() if line.strip()]
        return {int(number): value for number, value in rows}
    except ValueError:
        raise SealError("not a list of seals: each line is a number and a hash") from None


def trial_key(commit, key, number):
    """The integers that trial `number` is drawn from."""
    digest = hashlib.sha256(f"{commit}:{key}:{number}".encode()).digest()
    return tuple(int.from_bytes(digest[k : k + 4], "big") for k in range(0, 32, 4))


def git(*words, folder="."):
    """What git says, stripped. Raises SealError."""
    done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["failed"]
        raise SealError(f"git {words[0]}: {lines[-1]}; run inside a clone with its history")
    return done.stdout.strip()


def checked_out(folder):
    """The commit in a folder, "+" behind it where files differ; "" without a history."""
    try:
        changed = git("status", "--porcelain", "--untracked-files=no", folder=folder)
        return git("rev-parse", "HEAD", folder=folder) + ("+" if changed else "")
    except SealError:
        return ""


def publishing_commit(path):
    """Hash of the commit that published a file of seals, which must stand there unchanged since.

    Raises SealError where it is not committed, was changed later, or came with other files.
    """
    path = Path(path).resolve()
    log = git("log", "--format=%H", "--", path.name, folder=path.parent).split()
    if not log:
        raise SealError(f"{path.name}: not committed; commit the seals alone, then run")
    if len(log) > 1:
        raise SealError(f"{path.name}: changed after it was published; make new seals")
    if git("status", "--porcelain", "--", path.name, folder=path.parent):
        raise SealError(f"{path.name}: differs from what was committed; restore it")
    listing = git("show", "--format=", "--name-only", log[0], folder=path.parent).splitlines()
    if len(listing) != 1:
        raise SealError(f"{path.name}: was committed with other files; commit the seals alone")
    return log[0]


def is_ancestor(old, new, folder="."):
    """Does commit `old` lie before commit `new`, or is it the same?"""
    words = ["git", "merge-base", "--is-ancestor", old, new]
    return subprocess.run(words, cwd=folder, capture_output=True).returncode == 0
