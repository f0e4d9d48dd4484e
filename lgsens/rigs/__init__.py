"""Test rigs: kinematics and compliance (K&C) of an axle, with exact gradients."""

from lgsens.rigs._characteristics import (
    CHARACTERISTICS as CHARACTERISTICS,
    Characteristic as Characteristic,
    characteristics as characteristics,
)
from lgsens.rigs._curves import AxleCurves as AxleCurves, Vehicle as Vehicle, WheelCurves as WheelCurves
from lgsens.rigs._design import AxleDesign as AxleDesign, rack_way as rack_way, vehicle_of as vehicle_of
from lgsens.rigs._kc import KC as KC, kc as kc
from lgsens.rigs._pads import Pad as Pad, TyreLoad as TyreLoad, on_rig as on_rig
from lgsens.rigs._sweeps import Sweep as Sweep, standard_sweeps as standard_sweeps
