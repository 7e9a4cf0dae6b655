"""3MF files of several bodies, each for its own extruder.

Slicers agree on the meshes of a 3MF file but not on how parts and extruders are told: one writer per convention.
"""

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

from fab4d.mesh.tetmesh import FloatArray, IntArray

_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_PRUSA = "http://schemas.slic3r.org/3mf/2017/06"
_CURA = "http://software.ultimaker.com/xml/cura/3mf/2015/10"
_MODEL = "3D/3dmodel.model"
_DECLARATION = '<?xml version="1.0" encoding="UTF-8"?>\n'
_CONTENT_TYPES = (
    _DECLARATION + '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">\n'
    ' <Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>\n'
    ' <Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>\n'
    ' <Default Extension="config" ContentType="text/xml"/>\n'
    "</Types>\n"
)
_RELATIONSHIPS = (
    _DECLARATION + '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">\n'
    f' <Relationship Target="/{_MODEL}" Id="rel-1" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>\n'
    "</Relationships>\n"
)
_IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


@dataclass(frozen=True, eq=False)
class Part:
    """A named closed mesh: vertices (n, 3) in mm, faces (b, 3), extruder counted from 1, colour as #RRGGBB."""

    name: str
    extruder: int
    colour: str
    vertices: FloatArray
    faces: IntArray


def prusa_3mf(title: str, parts: Sequence[Part], lift: float = 0.0, description: str = "") -> bytes:
    """A 3MF file for PrusaSlicer: one mesh, of which each part is a range of triangles with its own extruder.

    lift : how far the part is moved up to stand on the bed, mm        description : what the file says about itself

    On overlap the last part wins. Equal parts give equal bytes.
    """
    mesh = ['  <object id="1" type="model">', *_mesh(parts), "  </object>"]
    model = [
        _DECLARATION + f'<model unit="millimeter" xml:lang="en-US" xmlns="{_CORE}" xmlns:slic3rpe="{_PRUSA}">',
        ' <metadata name="slic3rpe:Version3mf">1</metadata>',
        *_about(title, description),
        *_resources(mesh),
        *_build(1, lift),
        "</model>\n",
    ]
    config = "Metadata/Slic3r_PE_model.config"
    return _package({_MODEL: "\n".join(model), config: "\n".join(_prusa_config(title, parts))})


def components_3mf(title: str, parts: Sequence[Part], lift: float = 0.0, description: str = "") -> bytes:
    """A 3MF file for OrcaSlicer, Bambu Studio and Cura: one object with a component and an extruder per part.

    lift : how far the part is moved up to stand on the bed, mm        description : what the file says about itself

    On overlap the last part wins. Equal parts give equal bytes.
    """
    whole = len(parts) + 2
    lines = _base_materials(parts)
    for number, part in enumerate(parts):
        lines += [
            f'  <object id="{number + 2}" type="model" name={quoteattr(part.name)} pid="1" pindex="{number}">',
            "   <metadatagroup>",
            f'    <metadata name="cura:extruder_nr">{part.extruder - 1}</metadata>',
            "   </metadatagroup>",
            *_mesh([part]),
            "  </object>",
        ]
    lines += [f'  <object id="{whole}" type="model" name={quoteattr(title)}>', "   <components>"]
    lines += [f'    <component objectid="{number + 2}"/>' for number in range(len(parts))]
    lines += ["   </components>", "  </object>"]
    model = [
        _DECLARATION + f'<model unit="millimeter" xml:lang="en-US" xmlns="{_CORE}" xmlns:cura="{_CURA}">',
        *_about(title, description),
        *_resources(lines),
        *_build(whole, lift),
        "</model>\n",
    ]
    config = "\n".join(_orca_config(title, parts, whole))
    return _package({_MODEL: "\n".join(model), "Metadata/model_settings.config": config})


def _about(title: str, description: str) -> list[str]:
    told = {"Title": title, "Description": description}
    return [f' <metadata name="{key}">{escape(value)}</metadata>' for key, value in told.items() if value]


def _build(number: int, lift: float) -> list[str]:
    """The part on the bed: what lies below it a slicer may leave out."""
    return [" <build>", f'  <item objectid="{number}" transform="1 0 0 0 1 0 0 0 1 0 0 {lift + 0.0!r}"/>', " </build>"]


def _resources(lines: list[str]) -> list[str]:
    return [" <resources>", *lines, " </resources>"]


def _base_materials(parts: Sequence[Part]) -> list[str]:
    bases = [f'   <base name={quoteattr(part.name)} displaycolor="{part.colour}"/>' for part in parts]
    return ['  <basematerials id="1">', *bases, "  </basematerials>"]


def _mesh(parts: Sequence[Part]) -> list[str]:
    """One mesh of all parts, each with vertices of its own, so that every edge has two triangles."""
    lines, offset = ["   <mesh>", "    <vertices>"], 0
    for part in parts:
        # The shortest decimals that give the same number back.
        lines += [f'     <vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in part.vertices.tolist()]
    lines += ["    </vertices>", "    <triangles>"]
    for part in parts:
        lines += [f'     <triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in (part.faces + offset).tolist()]
        offset += len(part.vertices)
    return [*lines, "    </triangles>", "   </mesh>"]


def _prusa_config(title: str, parts: Sequence[Part]) -> list[str]:
    lines = [_DECLARATION + "<config>", ' <object id="1" instances_count="1">', _setting("object", "name", title)]
    first = 0
    for part in parts:
        lines += [
            f'  <volume firstid="{first}" lastid="{first + len(part.faces) - 1}">',
            _setting("volume", "name", part.name),
            _setting("volume", "volume_type", "ModelPart"),
            _setting("volume", "matrix", _IDENTITY),
            _setting("volume", "extruder", str(part.extruder)),
            "  </volume>",
        ]
        first += len(part.faces)
    return [*lines, " </object>", "</config>\n"]


def _setting(kind: str, key: str, value: str) -> str:
    return f'   <metadata type="{kind}" key="{key}" value={quoteattr(value)}/>'


def _orca_config(title: str, parts: Sequence[Part], whole: int) -> list[str]:
    lines = [_DECLARATION + "<config>", f' <object id="{whole}">', _option("name", title)]
    for number, part in enumerate(parts):
        lines += [
            f'  <part id="{number + 2}" subtype="normal_part">',
            _option("name", part.name),
            _option("matrix", _IDENTITY),
            _option("extruder", str(part.extruder)),
            "  </part>",
        ]
    return [*lines, " </object>", "</config>\n"]


def _option(key: str, value: str) -> str:
    return f'   <metadata key="{key}" value={quoteattr(value)}/>'


def _package(files: dict[str, str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as package:
        for path, text in {"[Content_Types].xml": _CONTENT_TYPES, "_rels/.rels": _RELATIONSHIPS, **files}.items():
            # Neither the clock nor the system goes into the file.
            entry = zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0))
            entry.compress_type, entry.create_system, entry.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
            package.writestr(entry, text.encode("utf-8"))
    return buffer.getvalue()
