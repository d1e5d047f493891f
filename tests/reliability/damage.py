"""Damage to files: what happens to bytes on disks and networks, and what nobody has written."""

from __future__ import annotations

import json

import numpy as np
from safetensors import safe_open
from safetensors.torch import load_file

import pyro_dynogp as dgp
from pyro_dynogp.inference.storage import FORMAT
from pyro_dynogp.support.checkpoints import write_tensors


def damaged(whole, kind, generator):
    """The bytes of a file with damage of a kind at a random place."""
    at = int(generator.integers(len(whole)))
    if kind == "flipped":
        return whole[:at] + bytes([whole[at] ^ (1 << int(generator.integers(8)))]) + whole[at + 1 :]
    if kind == "truncated":
        return whole[:at]
    if kind == "extended":
        return whole + bytes(at)
    if kind == "zeroed":
        return whole[:at] + bytes(min(512, len(whole) - at)) + whole[at + 512 :]
    if kind == "swapped":
        return whole[at:] + whole[:at]
    if kind == "random":
        return generator.bytes(at)
    if kind == "huge":  # a header that says it is as long as a disk
        return int(2 ** generator.integers(24, 63)).to_bytes(8, "little") + whole[8:]
    raise ValueError(kind)


KINDS = ("flipped", "truncated", "extended", "zeroed", "swapped", "random", "huge")
STRANGE = (None, -1, 0, 10**12, 1.5, "text", [], {}, [None], True, "draws", float("nan"))


def parts_of(path):
    """Header and tensors of a model file."""
    with safe_open(str(path), framework="pt") as file:
        header = json.loads(file.metadata()[FORMAT])
    return header, load_file(str(path))


def foreign(path, generator, target):
    """Write a file with a right digest in which one thing is wrong; what that is."""
    header, tensors = parts_of(path)
    if generator.random() < 0.3:
        name = str(generator.choice(sorted(tensors)))
        how = generator.integers(4)
        if how == 0:
            del tensors[name]
        elif how == 1:
            tensors[name] = tensors[name].reshape(-1)[1:].clone()
        elif how == 2:
            tensors[name] = tensors[name].float()
        else:
            tensors[name] = tensors[name] * float("nan")
        told = f"tensor {name}, {how}"
    else:
        inside, trail = header, []
        while isinstance(inside, dict | list) and inside:
            keys = list(inside) if isinstance(inside, dict) else range(len(inside))
            key = keys[int(generator.integers(len(keys)))]
            trail.append(key)
            if not isinstance(inside[key], dict | list) or generator.random() < 0.2:
                break
            inside = inside[key]
        told = f"header {trail}"
        if isinstance(inside, dict | list) and len(inside):
            strange = STRANGE[int(generator.integers(len(STRANGE)))]
            if generator.random() < 0.2 and isinstance(inside, dict):
                del inside[trail[-1]]
                strange = "left out"
            else:
                inside[trail[-1]] = strange
            told += f": {strange!r}"
    write_tensors(target, tensors, {FORMAT: json.dumps(header)})
    return told


def outcome(path, original):
    """How reading a file ends: refused in a sentence, the same fit, another, or a crash."""
    try:
        fit = dgp.load(path)
    except ValueError as error:
        return "refused" if str(path) in str(error) else f"does not name the file: {error}"
    except Exception as error:
        return f"crash: {error!r}"
    same = fit.draws.keys() == original.draws.keys() and all(
        np.array_equal(fit.draws[k], original.draws[k]) for k in fit.draws
    )
    return "same" if same and fit.model == original.model else "another"
