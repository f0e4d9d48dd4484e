"""Models from files of other programs: MJCF, URDF, and suspensions of Chrono's vehicle data."""

from lgsens.importers._chrono import chrono as chrono
from lgsens.importers._mjcf import mjcf as mjcf, urdf as urdf
from lgsens.importers._report import Imported as Imported, Report as Report
