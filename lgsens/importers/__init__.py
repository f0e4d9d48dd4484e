"""Models from files of other programs: MJCF and URDF."""

from lgsens.importers._mjcf import mjcf as mjcf, urdf as urdf
from lgsens.importers._report import Imported as Imported, Report as Report
