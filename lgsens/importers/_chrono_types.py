"""The types of Chrono's suspensions: what is in each of them, and what connects what, as rows of a table.

A row is the name of a method of `Assembly` and its arguments. Bodies are called by the section of the file that
describes them, "" is the chassis; a point or an axis is "Section/Key". A body is there on both sides and its row is
done twice, with y → −y; a name that begins with * is there once, between the sides. In rows of such, "left …" and
"right …" choose a side, "near …" that on which the point lies, and a point that ends in ~ is mirrored.

The files name points and numbers, and no joints. These follow from the names of the points, the description of the
types in Chrono's manual, and counting freedoms: one for each wheel of an independent suspension, heave and roll for an
axle, and none for what steers where the steering is held.
"""

from typing import Any

Row = tuple[Any, ...]

TUBE = "*Axle Tube"


def _spring(section: str, body: str, key: str) -> Row:
    return ("spring", section, "", f"{section}/Location Chassis", body, f"{section}/{key}")


def _struts(body: str, key: str, spring: str = "Spring", shock: str = "Shock") -> list[Row]:
    return [_spring(section, body, key) for section in (spring, shock) if section]


def _arm(section: str, to: str = "Upright", at: str = "Location Upright") -> Row:
    """A wishbone: a hinge on the chassis through two points, a ball at the third one."""
    return (
        "arm",
        section,
        f"{section}/Location Chassis Front",
        f"{section}/Location Chassis Back",
        to,
        f"{section}/{at}",
    )


def _link(section: str, to: str, at: str, begin: str = "Location Chassis") -> Row:
    """A rod from the chassis."""
    name = section.removeprefix("*")
    return ("rod", section, "", f"{name}/{begin}", to, f"{name}/{at}")


_TIE = _link("Tierod", "Upright", "Location Upright")

_KINGPINS: list[Row] = [
    ("body", "Knuckle"),
    ("hinge", TUBE, "Knuckle", "Knuckle/Location Lower", "Knuckle/Location Lower..Knuckle/Location Upper"),
    ("spindle", "Knuckle"),
]
# a rod between both knuckles, and one to the steering
_TOE_BAR: list[Row] = [
    *_KINGPINS,
    ("rod", "*Tierod", "right Knuckle", "Tierod/Location Knuckle~", "left Knuckle", "Tierod/Location Knuckle"),
    ("rod", "*Draglink", "", "Draglink/Location Chassis", "near Knuckle", "Knuckle/Location Draglink"),
]
_AXLE: list[Row] = [("body", TUBE), *_struts(TUBE, "Location Axle")]
# Heave and roll only: leaf springs that have no parts hold the axle along x and y and against pitch and yaw.
_LEAVES: list[Row] = [("face", "", TUBE, "Axle Tube/COM", "x"), ("plane", "", TUBE, "Axle Tube/COM", "y")]
# They hold it along x, and the rod across.
_PANHARD: list[Row] = [
    ("face", "", TUBE, "Axle Tube/COM", "x"),
    _link("*Panhard Rod", TUBE, "Location Axle"),
    ("body", "Anti Roll Bar", "Anti Roll Bar/Location Chassis", "Anti Roll Bar/Location Axle"),
    ("hinge", "", "Anti Roll Bar", "Anti Roll Bar/Location Chassis", "y"),
    ("plane", TUBE, "Anti Roll Bar", "Anti Roll Bar/Location Axle", "z"),
    (
        "torsion",
        "left Anti Roll Bar",
        "right Anti Roll Bar",
        "y",
        "Anti Roll Bar",
        "Rotational Stiffness",
        "Rotational Damping",
    ),
]
_PIPE: list[Row] = [
    ("ball", "", TUBE, "Axle Tube/Location Connector Chassis"),
    _link("*Panhard Rod", TUBE, "Location Connector Axle", "Location Connector Chassis"),
]
_WATT: list[Row] = [
    ("ball", "", TUBE, "Axle Tube/Location Connector Chassis"),
    ("body", "*Center Link"),
    ("hinge", TUBE, "*Center Link", "Center Link/COM", "x"),
    _link("*Left Link", "*Center Link", "Location Center"),
    _link("*Right Link", "*Center Link", "Location Center"),
]
# The three links of SAE's spring design manual: leaf, clamp and leaf, with a shackle; torsion springs for the leaves.
_SAE: list[Row] = [
    ("body", TUBE),
    *_struts(TUBE, "Location Axle", "Auxiliary Spring"),
    *(("body", name) for name in ("Frontleaf", "Rearleaf", "Clamp A", "Clamp B", "Shackle")),
    ("ball", "", "Frontleaf", "Leafspring/Location Front Hanger"),
    ("hinge", "Clamp A", "Frontleaf", "Leafspring/Location Clamp A", "y"),
    ("hinge", TUBE, "Clamp A", "Leafspring/Location Clamp A", "z"),
    ("hinge", TUBE, "Clamp B", "Leafspring/Location Clamp B", "z"),
    ("hinge", "Clamp B", "Rearleaf", "Leafspring/Location Clamp B", "y"),
    ("ball", "Rearleaf", "Shackle", "Leafspring/Location Shackle"),
    ("hinge", "", "Shackle", "Leafspring/Location Rear Hanger", "y"),
    *(
        ("torsion", a, b, axis, section, "Stiffness", "Damping", "Preload")
        for a, b, axis, section in (
            ("Clamp A", "Frontleaf", "y", "Front Bending"),
            ("Clamp B", "Rearleaf", "y", "Rear Bending"),
            (TUBE, "Clamp A", "z", "Lateral Bending"),
            (TUBE, "Clamp B", "z", "Lateral Bending"),
        )
    ),
]
_TRIANGLE: list[Row] = [
    ("body", TUBE),
    (
        *("arm", "*Triangular Link", "Triangular Link/Location Chassis", "Triangular Link/Location Chassis~"),
        *(TUBE, "Triangular Link/Location Axle"),
    ),
    _link("Longitudinal Link", TUBE, "Location Axle"),
    *_struts(TUBE, "Location Axle"),
]
_ON_TUBE: Row = ("spindle", TUBE)
_HOUSING = "*Axle Housing"

# Whose equations may repeat others: all rods of the former are in planes along x.
REPEATING = ("HendricksonPRIMAXX", "GenericWheeledSuspension")

TYPES: dict[str, list[Row]] = {
    "DoubleWishbone": [
        ("body", "Upright"),
        _arm("Upper Control Arm"),
        _arm("Lower Control Arm"),
        _TIE,
        *_struts("Lower Control Arm", "Location Arm"),
        ("spindle", "Upright"),
    ],
    "DoubleWishboneReduced": [
        ("body", "Upright"),
        *(
            ("distance", f"{arm} {side}", "", f"{arm}/Location Chassis {side}", "Upright", f"{arm}/Location Upright")
            for arm in ("Upper Control Arm", "Lower Control Arm")
            for side in ("Front", "Back")
        ),
        _TIE,
        *_struts("Upright", "Location Upright", ""),
        ("spindle", "Upright"),
    ],
    "SingleWishbone": [
        ("body", "Upright"),
        ("body", "Control Arm"),
        ("hinge", "", "Control Arm", "Control Arm/Location Chassis", "x"),
        ("hinge", "Control Arm", "Upright", "Control Arm/Location Upright", "z"),
        _TIE,
        *_struts("Control Arm", "Location Arm", ""),
        ("spindle", "Upright"),
    ],
    "MacPhersonStrut": [
        ("body", "Upright"),
        _arm("Control Arm"),
        _TIE,
        ("body", "Strut", "Spring/Location Chassis", "Spring/Location Upright"),
        (
            "universal",
            "",
            "Strut",
            "Spring/Location Chassis",
            "Spring/Location Chassis..Spring/Location Upright",
            "Strut",
        ),
        ("slider", "Strut", "Upright", "Spring/Location Upright", "Spring/Location Chassis..Spring/Location Upright"),
        *_struts("Upright", "Location Upright"),
        ("spindle", "Upright"),
    ],
    "MultiLink": [
        ("body", "Upright"),
        _arm("Upper Arm"),
        _link("Lateral", "Upright", "Location Upright"),
        _link("Trailing Link", "Upright", "Location Upright"),
        _TIE,
        *_struts("Trailing Link", "Location Link"),
        ("spindle", "Upright"),
    ],
    "SemiTrailingArm": [
        ("body", "Trailing Arm"),
        (
            *("hinge", "", "Trailing Arm", "Trailing Arm/Location Chassis Outer"),
            "Trailing Arm/Location Chassis Inner..Trailing Arm/Location Chassis Outer",
        ),
        *_struts("Trailing Arm", "Location Arm"),
        ("spindle", "Trailing Arm"),
    ],
    "ThreeLinkIRS": [
        ("body", "Trailing Arm"),
        ("ball", "", "Trailing Arm", "Trailing Arm/Location Chassis"),
        _link("Upper Link", "Trailing Arm", "Location Arm"),
        _link("Lower Link", "Trailing Arm", "Location Arm"),
        *_struts("Trailing Arm", "Location Arm"),
        ("spindle", "Trailing Arm"),
    ],
    "RigidSuspension": [("spindle", "")],
    "RigidPinnedAxle": [("body", "*Tube"), ("hinge", "", "*Tube", "Tube/Pin Location", "x"), ("spindle", "*Tube")],
    "SolidAxle": [
        *_AXLE,
        _link("Upper Link", TUBE, "Location Axle"),
        _link("Lower Link", TUBE, "Location Axle"),
        ("option", *_link("*Trackbar", TUBE, "Location Axle")),  # with it four links and a rod lock the roll
        *_KINGPINS,
        ("rod", "*Tierod", "right Knuckle", "Tierod/Location Knuckle~", "left Knuckle", "Tierod/Location Knuckle"),
        ("body", "*Bell Crank", "Bell Crank/Location Axle", "Bell Crank/Location Tierod"),
        ("hinge", TUBE, "*Bell Crank", "Bell Crank/Location Axle", "z"),
        ("plane", "*Tierod", "*Bell Crank", "Bell Crank/Location Tierod", "y"),
        _link("*Draglink", "*Bell Crank", "Location Bell Crank"),
    ],
    "LeafspringAxle": [*_AXLE, *_LEAVES, _ON_TUBE],
    "ToeBarLeafspringAxle": [*_AXLE, *_LEAVES, *_TOE_BAR],
    "SAELeafspringAxle": [*_SAE, _ON_TUBE],
    "SAEToeBarLeafspringAxle": [*_SAE, *_TOE_BAR],
    "RigidPanhardAxle": [*_AXLE, *_PANHARD, _ON_TUBE],
    "ToeBarRigidPanhardAxle": [*_AXLE, *_PANHARD, *_TOE_BAR],
    "PushPipeAxle": [*_AXLE, *_PIPE, _ON_TUBE],
    "ToeBarPushPipeAxle": [*_AXLE, *_PIPE, *_TOE_BAR],
    "DeDionAxle": [*_AXLE, *_WATT, _ON_TUBE],
    "ToeBarDeDionAxle": [*_AXLE, *_WATT, *_TOE_BAR],
    "SolidThreeLinkAxle": [*_TRIANGLE, _ON_TUBE],
    "SolidBellcrankThreeLinkAxle": [
        *_TRIANGLE,
        *_KINGPINS,
        ("body", "*Bellcrank", "Bellcrank/Location Axle", "Bellcrank/Location Axle"),
        ("hinge", TUBE, "*Bellcrank", "Bellcrank/Location Axle", "z"),
        ("rod", "Tierod", "*Bellcrank", "Bellcrank/Location Tierod", "Knuckle", "Knuckle/Location Tierod"),
        _link("*Draglink", "*Bellcrank", "Location Bellcrank", "Location Steering"),
    ],
    "HendricksonPRIMAXX": [
        ("body", _HOUSING),
        ("body", "*Transverse Beam"),
        _link("Torque Rod", _HOUSING, "Axle Housing Attachment Point", "Chassis Attachment Point"),
        _link("Lower Beam", _HOUSING, "Axle Housing Attachment Point", "Chassis Attachment Point"),
        (
            *("universal", "right Lower Beam", "*Transverse Beam", "Lower Beam/Transverse Beam Attachment Point~"),
            *("y", "Transverse Beam"),
        ),
        ("ball", "left Lower Beam", "*Transverse Beam", "Lower Beam/Transverse Beam Attachment Point"),
        ("body", "Knuckle"),
        (
            *("hinge", _HOUSING, "Knuckle", "Knuckle/Lower Attachment Point"),
            "Knuckle/Lower Attachment Point..Knuckle/Upper Attachment Point",
        ),
        _link("Tierod", "Knuckle", "Location Knuckle"),
        _spring("Shock Axle Housing", _HOUSING, "Location Axle Housing"),
        _spring("Shock Lower Beam", "Lower Beam", "Location Lower Beam"),
        ("spindle", "Knuckle"),
    ],
    "TranslationalDamperSuspension": [
        ("body", "*Suspension Arm"),
        ("hinge", "", "*Suspension Arm", "Suspension Arm/Location Chassis", "y"),
        (
            "torsion",
            "",
            "*Suspension Arm",
            "y",
            "Torsional Spring",
            "Spring Constant",
            "Damping Coefficient",
            "Preload",
        ),
        _spring("Damper", "*Suspension Arm", "Location Arm"),
    ],
    "TorsionArmSuspension": [
        ("body", "*Arm", "Arm/Location Chassis", "Wheel/Location"),
        ("body", "*Wheel", "Wheel/Location", "Wheel/Location"),
        ("hinge", "", "*Arm", "Arm/Location Chassis", "y"),
        ("hinge", "*Arm", "*Wheel", "Wheel/Location", "y"),
        ("torsion", "", "*Arm", "y", "Torsion Bar", "Stiffness", "Damping"),
    ],
}
