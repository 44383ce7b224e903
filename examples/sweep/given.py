"""Reads the file that says what a sweep trains, and checks all of it."""
import re
import sys
import tomllib

# The largest whole number that the program takes.
LARGEST = 2**63 - 1


def is_whole(least):
    return lambda value: type(value) is int and least <= value <= LARGEST


def is_text(value):
    return isinstance(value, str) and "\0" not in value


def is_number(value):
    return type(value) in (int, float) and abs(value) < 1e300


def is_list_of(fits):
    return lambda value: isinstance(value, list) and all(map(fits, value))


def are_seeds(value):
    return is_list_of(is_whole(0))(value) and 0 < len(value) == len(set(value))


COUNT = is_whole(1), "a whole number of at least 1"
COUNTS = is_list_of(is_whole(1)), "a list of whole numbers of at least 1"
TEXT = is_text, "a text"
TEXTS = is_list_of(is_text), "a list of texts"
NUMBER = is_number, "a number"
TABLE = (lambda value: isinstance(value, dict)), "a table"

# The keys of the file, of a variant and of a stop rule, and what each must be.
FILE = {"steps": COUNT, "seeds": (are_seeds, "a list of whole numbers, each once"), "set": TEXTS, "variants": TABLE,
        "stop": (is_list_of(TABLE[0]), "a list of tables"), "keep": COUNTS, "table": COUNTS, "window": COUNT, "config": TEXT,
        "fork": TEXT, "runs": COUNT, "threads": COUNT}
VARIANT = {"set": TEXTS, "steps": COUNT}
RULE = {"at": COUNT, "metric": TEXT, "below": NUMBER, "above": NUMBER}


def expect(where, given, kinds):
    """Exits unless all keys are known, and each value is what it must be."""
    if unknown := set(given) - set(kinds):
        sys.exit(f"{where}: unknown: {', '.join(sorted(unknown))}")
    for key, value in given.items():
        fits, kind = kinds[key]
        if not fits(value):
            sys.exit(f"{where}: {key} = {repr(value)[:60]} must be {kind}")


def read(file):
    """Returns what a file says, or exits with what is wrong with it."""
    try:
        given = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        sys.exit(f"{file}: {error}")
    expect(file, given, FILE)
    if "steps" not in given:
        sys.exit(f"{file}: `steps` is missing")
    for name, variant in given.get("variants", {}).items():
        if name == "base" or not re.fullmatch(r"[\w.+-]+", name):
            sys.exit(f"{file}: a variant cannot be called {name!r}: its name is one of a folder, and `base` is what it is compared with")
        if not isinstance(variant, dict):
            sys.exit(f"{file}: the variant {name} must be a table with `set` or `steps`")
        expect(f"{file}, variant {name}", variant, VARIANT)
    for rule in given.get("stop", []):
        expect(f"{file}, stop rule", rule, RULE)
        if not {"at", "metric"} < set(rule):
            sys.exit(f"{file}: a stop rule needs `at`, `metric`, and `below` or `above`: {rule}")
    if "fork" in given and "{seed}" not in given["fork"] and len(given.get("seeds", "two")) > 1:
        sys.exit(f"{file}: `fork` must contain {{seed}}, or all seeds would be the same training from one checkpoint")
    return given
