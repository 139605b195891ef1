"""Makes asterix_oracle.json: ASTERIX built by libasterix (MIT), and what libasterix reads out of it again.

    pip install libasterix==0.36.3 && python make_asterix_oracle.py

Two kinds of blocks. ``layouts``: records with every item of a category at random, and the bytes of each item, so that
our table of lengths is compared with the published specifications item by item. ``records``: targets with quantities in
their units, as libasterix decodes them.
"""

import json
import random
from pathlib import Path

import asterix.base as base
import asterix.generated as generated

EDITIONS = {
    21: ("Cat_021_2_1", "Cat_021_2_7"),
    48: ("Cat_048_1_27", "Cat_048_1_32"),
    62: ("Cat_062_1_16", "Cat_062_1_21"),
}
ITEMS_LEFT_OUT = ("RE", "SP")


def variation_of(rule):
    """What a rule allows; of rules that depend on other items the one that holds by default."""
    return getattr(rule, "cv_variation", None) or rule.cv_default_variation


def named(item):
    """The item with a name behind an entry of a list; None for a spare bit."""
    item = getattr(item, "cv_non_spare", item)
    return item if hasattr(item, "cv_name") else None


def bits_of(item):
    item = item[0] if isinstance(item, tuple) else item
    if hasattr(item, "cv_bit_size"):
        return item.cv_bit_size
    return variation_of(getattr(item, "cv_non_spare", item).cv_rule).cv_bit_size


def random_bytes(rng, variation):
    """Any bytes that this variation may have."""
    if issubclass(variation, (base.Element, base.Group)):
        return bytes(rng.randrange(256) for _ in range(variation.cv_bit_size // 8))
    if issubclass(variation, base.Extended):
        groups = variation.cv_items_list
        sizes = [(sum(bits_of(item) for item in group if item is not None) + 1) // 8 for group in groups]
        return with_extension(rng, sizes[: rng.randint(1, len(sizes))])
    if issubclass(variation, base.Repetitive):
        if variation.cv_rep_bytes is None:
            size = (variation.cv_variation.cv_bit_size + 1) // 8
            return with_extension(rng, [size] * rng.randint(1, 3))
        parts = [random_bytes(rng, variation.cv_variation) for _ in range(rng.randint(1, 3))]
        return bytes([len(parts)]) + b"".join(parts)
    if issubclass(variation, base.Compound):
        return with_specification(rng, variation.cv_items_list, [None] * len(variation.cv_items_list))
    raise TypeError(variation)


def with_extension(rng, sizes):
    out = b""
    for k, size in enumerate(sizes):
        part = bytearray(rng.randrange(256) for _ in range(size))
        part[-1] = part[-1] & 0xFE | (k + 1 < len(sizes))
        out += bytes(part)
    return out


def with_specification(rng, items, wanted):
    """A field specification and the items that it names; ``wanted`` says yes or no, None leaves it to chance."""
    present = [named(item) is not None for item in items]
    present = [here and (rng.random() < 0.7 if say is None else say) for here, say in zip(present, wanted, strict=True)]
    if not any(present):
        present[next(k for k, item in enumerate(items) if named(item))] = True
    last = max(k for k, here in enumerate(present) if here) // 7
    head = bytes(
        sum(128 >> k for k in range(7) if 7 * n + k < len(present) and present[7 * n + k]) | (n < last)
        for n in range(last + 1)
    )
    chosen = [named(item) for item, here in zip(items, present, strict=True) if here]
    return head + b"".join(random_bytes(rng, variation_of(item.cv_rule)) for item in chosen)


def read_again(category, record):
    """Hexadecimal bytes of every item as libasterix cuts them; compounds by subfield."""
    found = {}
    for item in category.cv_record.cv_items_list:
        if named(item) is None:
            continue
        name = named(item).cv_name
        value = record.get_item(name)
        if value is None:
            continue
        kind = variation_of(named(item).cv_rule)
        if issubclass(kind, base.Compound):
            parts = {named(part).cv_name for part in kind.cv_items_list if named(part)}
            values = {part: value.variation.get_item(part) for part in parts}
            found[name] = {k: v.unparse().to_bytes().hex() for k, v in sorted(values.items()) if v is not None}
        else:
            found[name] = value.unparse().to_bytes().hex()
    return found


def layouts(rng):
    made = []
    for number, editions in EDITIONS.items():
        for edition in editions:
            category = getattr(generated, edition)
            items = category.cv_record.cv_items_list
            wanted = [False if named(i) is None or named(i).cv_name in ITEMS_LEFT_OUT else None for i in items]
            data = b"".join(with_specification(rng, items, wanted) for _ in range(4))
            records = category.cv_uap.parse(base.Bits.from_bytes(data))
            assert not isinstance(records, ValueError), (edition, records)
            read = [read_again(category, record) for record in records]
            made.append({"category": number, "edition": edition, "data": data.hex(), "records": read})
    return made


def records():
    """Targets in physical units, and the same as libasterix reads them back."""
    c21, c48, c62 = generated.Cat_021_2_7, generated.Cat_048_1_32, generated.Cat_062_1_21
    radar = c48.cv_record.create(
        {
            "010": (("SAC", 25), ("SIC", 201)),
            "140": ((86399.5, "s")),
            "020": ((("TYP", 5), 0, 0, 0, 0, None),),
            "040": (("RHO", (101.25, "NM")), ("THETA", (271.5, "°"))),
            "070": (0, 0, 0, 0, ("MODE3A", "7421")),
            "090": (0, 0, ("FL", (351.25, "FL"))),
            "220": 0x3C660C,
            "240": "DLH65A  ",
            "161": (0, 3563),
            "200": (("GSP", (0.12, "NM/s")), ("HDG", (124.0, "°"))),
            "210": (("SIGX", (0.0625, "NM")), ("SIGY", (0.125, "NM")), ("SIGV", (0.001, "NM/s")), ("SIGH", (0.5, "°"))),
        }
    )
    track = c62.cv_record.create(
        {
            "010": (("SAC", 25), ("SIC", 10)),
            "070": ((12.25, "s")),
            "105": (("LAT", (-33.9461, "°")), ("LON", (151.1772, "°"))),
            "100": (("X", (-12000.5, "m")), ("Y", (8000.0, "m"))),
            "185": (("VX", (-51.25, "m/s")), ("VY", (170.0, "m/s"))),
            "060": (0, 0, 0, 0, ("MODE3A", "4276")),
            "380": {"ADR": 0x7C6B2D, "ID": "QFA12   "},
            "040": 4980,
            "136": ((331.0, "FL")),
            "130": ((33500.0, "ft")),
            "220": ((-600.0, "ft/min")),
            "500": {
                "APC": (("X", (60.0, "m")), ("Y", (80.5, "m"))),
                "COV": ((-35.5, "m")),
                "APW": (("LAT", (0.0005, "°")), ("LON", (0.0004, "°"))),
                "ATV": (("X", (1.25, "m/s")), ("Y", (2.5, "m/s"))),
                "AGA": ((50.0, "ft")),
            },
        }
    )
    aircraft = c21.cv_record.create({
        "010": (("SAC", 25), ("SIC", 7)), "080": 0x4CA7A8, "161": (0, 77), "071": ((43200.25, "s")),
        "131": (("LAT", (41.1671, "°")), ("LON", (-15.7088, "°"))), "140": ((36512.5, "ft")), "145": ((390.0, "FL")),
        "160": (0, ("GS", (0.125, "NM/s")), ("TA", (101.25, "°"))), "157": (0, ("GVR", (-1200.0, "ft/min"))),
        "170": "RYR174C ", "070": 0o1275, "210": (0, 0, ("VN", 2), ("LTT", 2)),
        "090": ((("NUCRNACV", 2), ("NUCPNIC", 8), None), (0, ("SIL", 3), ("NACP", 9), None)),
    })  # fmt: skip
    made = []
    for category, record in ((c48, radar), (c62, track), (c21, aircraft)):
        block = category.create([record]).unparse().to_bytes()
        [again] = category.cv_uap.parse(base.RawDatablock.parse(base.Bits.from_bytes(block))[0].get_raw_records())
        made.append({"block": block.hex(), "values": values_of(category, again)})
    return made


def values_of(category, record):
    """Physical values by item and subfield, those libasterix has units for."""
    found = {}
    for item in category.cv_record.cv_items_list:
        if named(item):
            value = record.get_item(named(item).cv_name)
            if value is not None:
                found |= leaves(named(item).cv_name, value, variation_of(named(item).cv_rule))
    return found


def leaves(name, value, kind):
    variation = value.variation
    if issubclass(kind, (base.Group, base.Compound)):
        found = {}
        for part in kind.cv_items_list:
            part = part[0] if isinstance(part, tuple) else part
            if named(part):
                own = variation.get_item(named(part).cv_name)
                if own is not None:
                    found |= leaves(f"{name}.{named(part).cv_name}", own, variation_of(named(part).cv_rule))
        return found
    if not issubclass(kind, base.Element):
        return {}
    content = variation.content
    if hasattr(content, "as_quantity"):
        return {name: content.as_quantity(None)}
    if hasattr(content, "as_string"):
        return {name: content.as_string()}
    return {name: variation.as_uint()}


if __name__ == "__main__":
    rng = random.Random(20260506)
    oracle = {"layouts": layouts(rng), "records": records()}
    Path(__file__).with_name("asterix_oracle.json").write_text(json.dumps(oracle, indent=0) + "\n")
