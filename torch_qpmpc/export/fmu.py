"""`export_fmu`: the C of a policy as an FMU, a component of Simulink, Modelica tools and FMPy."""

import hashlib
import platform
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from torch_qpmpc.export.export import Export, build
from torch_qpmpc.export.library import FLAGS, built, required_compiler
from torch_qpmpc.export.tables import make_tables
from torch_qpmpc.export.writer import Settings, filled
from torch_qpmpc.mpc.module import QPMPC

#: The values of the variable ``status``: the codes of C, in their order.
CODES = ("SOLVED", "LIMIT", "INFEASIBLE", "INVALID", "MISSING", "NODE_LIMIT")
#: FMI's words for machines and systems, and what a library's name ends with.
MACHINES = {"AMD64": "x86_64", "arm64": "aarch64"}
SYSTEMS = {"win32": ("windows", "dll"), "darwin": ("darwin", "dylib")}
#: What is no number in C without math.h, and in XML.
IN_C = {"nan": "0.0 / 0.0", "inf": "1e999", "-inf": "-1e999"}
IN_XML = {"nan": "NaN", "inf": "INF", "-inf": "-INF", "True": "true", "False": "false"}


class Variable(NamedTuple):
    """A variable: an "input", "parameter", "output" or "constant" with a description and a unit.

    It is a number, a vector or a bool as ``start`` is, its value at the start.
    """

    name: str
    causality: str
    start: Any
    about: str
    unit: str | None = None


def export_fmu(
    mpc: QPMPC,
    path: str | Path,
    *,
    name: str = "policy",
    max_iterations: int | None = None,
) -> Export:
    """Write the policy of the current theta as an FMU of FMI 3.0 for co-simulation.

    Inputs are the state ``x`` and, with a preview, ``d`` with its stages; outputs are ``u``,
    ``value`` and ``status``, with which ``u.lower`` and ``u.upper`` are u's bounds. A step takes a
    second. The FMU has the sources of `export_c` and a library for this machine.

    Args:
        mpc, max_iterations: as in `export_c`.
        path: the file, such as ``policy.fmu``.
        name: the model's identifier.

    Returns:
        The report of `export_c`, with ``path`` as its only file.

    Raises:
        QPError: no C compiler is installed, or as in `export_c`.

    Example:
        >>> import tempfile, torch_qpmpc as qm
        >>> mpc = qm.QPMPC.from_model([[1]], [[1]], 3, stage_weight=[1, 1])
        >>> export = qm.export_fmu(mpc, tempfile.mkdtemp() + "/policy.fmu")
        >>> [file.name for file in export.files]
        ['policy.fmu']
    """
    required_compiler()
    tables = make_tables(mpc)
    p, u = np.zeros(mpc.n_p), np.zeros(mpc.n_u)
    ahead = p[: mpc.n_p - mpc.n_x]
    variables = [
        *([Variable("d", "input", ahead, "known signals, stage by stage")] if len(ahead) else []),
        Variable("x", "input", p[len(ahead) :], "state"),
        Variable("u", "output", u, "action"),
        Variable("value", "output", 0.0, "cost to go"),
        Variable("u.lower", "constant", tables.u_lower, "bounds of u"),
        Variable("u.upper", "constant", tables.u_upper, "bounds of u"),
    ]
    report, texts, _ = build(mpc, Settings(name, "float64", max_iterations))
    return replace(report, files=(write_fmu(path, name, texts, variables),))


def write_fmu(
    path: str | Path,
    name: str,
    texts: Mapping[str, str],
    variables: Sequence[Variable],
    dt: float = 1.0,
) -> Path:
    """Write an FMU around the C files ``texts`` by name, and return its path.

    The variables are inputs and parameters, outputs, then constants and flags, as in
    ``fmu.c``; ``dt`` is the sample time in seconds.

    Raises:
        QPError: no C compiler is installed, or it fails.
    """
    digest = hashlib.sha256(repr((dt, variables, sorted(texts.items()))).encode()).hexdigest()
    code = filled("fmu.c", name, {"/* @VARIABLES@ */": _tables(variables, dt, digest)})
    texts = {**texts, f"{name}_fmu.c": code}
    system, ending = SYSTEMS.get(sys.platform, ("linux", "so"))
    machine = MACHINES.get(platform.machine(), platform.machine())
    files = "".join(f'<SourceFile name="{file}"/>' for file in texts if file.endswith(".c"))
    files = f'<SourceFileSet language="C99">{files}</SourceFileSet>'
    files = f'<BuildConfiguration modelIdentifier="{name}">{files}</BuildConfiguration>'
    files = f'<fmiBuildDescription fmiVersion="3.0">{files}</fmiBuildDescription>'
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        library = built(texts, FLAGS, Path(folder) / f"{name}.{ending}").read_bytes()
    path.unlink(missing_ok=True)  # may be a link, which would be followed
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", _described(name, variables, dt, digest))
        archive.writestr("sources/buildDescription.xml", files)
        for file, text in texts.items():
            archive.writestr(f"sources/{file}", text)
        archive.writestr(f"binaries/{machine}-{system}/{name}.{ending}", library)
    return path


def _tables(variables: Sequence[Variable], dt: float, digest: str) -> str:
    """Return what ``fmu.c`` knows of its variables."""
    numbers = [x for x in variables if not isinstance(x.start, bool)]
    places = np.cumsum([0, *(np.size(x.start) for x in numbers)]).tolist()
    values = map(repr, np.concatenate([np.ravel(x.start) for x in numbers]).tolist())
    settable = sum(x.causality in ("input", "parameter") for x in numbers)
    sizes = {"NUMBERS": len(numbers), "VALUES": places[-1], "SETTABLE": places[settable]}
    flags = len(variables) - len(numbers)
    sizes |= {"FLAGS": flags, "FLAGS_": max(flags, 1)}
    return (
        f"enum {{ {', '.join(f'{key} = {x}' for key, x in sizes.items())} }};\n"
        f"static const double STEP = {dt!r};\n"
        f'static const char TOKEN[] = "{digest}";\n'
        f"static const int PLACE[] = {{{', '.join(map(str, places))}}};\n"
        f"static const double START[] = {{{', '.join(IN_C.get(x, x) for x in values)}}};"
    )


def _described(name: str, variables: Sequence[Variable], dt: float, digest: str) -> bytes:
    """Return the model description."""
    about = {"fmiVersion": "3.0", "modelName": name, "instantiationToken": digest}
    about |= {"generationTool": "torch_qpmpc", "variableNamingConvention": "flat"}
    model = ElementTree.Element("fmiModelDescription", about)

    def add(parent: Any, tag: str, **attributes: Any) -> Any:
        return ElementTree.SubElement(parent, tag, {k: str(x) for k, x in attributes.items()})

    able = {"canGetAndSetFMUState": "true", "fixedInternalStepSize": dt}
    add(model, "CoSimulation", modelIdentifier=name, **able)
    if units := {x.unit: None for x in variables if x.unit}:
        definitions = add(model, "UnitDefinitions")
        for unit in units:
            add(definitions, "Unit", name=unit)
    codes = add(add(model, "TypeDefinitions"), "EnumerationType", name="Outcome")
    for value, code in enumerate(CODES):
        add(codes, "Item", name=code, value=value)
    add(model, "DefaultExperiment", startTime=0, stepSize=dt)
    listed, structure = add(model, "ModelVariables"), add(model, "ModelStructure")
    time = {"causality": "independent", "variability": "continuous"}
    add(listed, "Float64", name="time", valueReference=0, **time)
    variability = {"parameter": "fixed", "constant": "constant"}
    for reference, x in enumerate(variables, 1):
        start, is_flag = np.ravel(x.start), isinstance(x.start, bool)
        made = add(listed, "Boolean" if is_flag else "Float64", name=x.name)
        made.attrib |= {"valueReference": str(reference), "description": x.about}
        made.set("causality", "local" if x.causality == "constant" else x.causality)
        made.set("variability", variability.get(x.causality, "discrete"))
        if x.unit:
            made.set("unit", x.unit)
        if x.causality != "output":
            made.set("start", " ".join(IN_XML.get(x, x) for x in map(repr, start.tolist())))
        if np.ndim(x.start):
            add(made, "Dimension", start=len(start))
    codes = {"declaredType": "Outcome", "causality": "output", "variability": "discrete"}
    last = len(variables) + 1
    add(listed, "Enumeration", name="status", valueReference=last, **codes)
    outputs = [i for i, x in enumerate(variables, 1) if x.causality == "output"]
    for tag in ("Output", "InitialUnknown"):
        for reference in (*outputs, last):
            add(structure, tag, valueReference=reference)
    return ElementTree.tostring(model, encoding="utf-8", xml_declaration=True)
