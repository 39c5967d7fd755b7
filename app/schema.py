"""What an option is: its meaning, unit, default, choices and range, said once for files, flags and documents."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterator
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.fields import FieldInfo

_BOUNDS = ((Gt, "gt", ">"), (Ge, "ge", ">="), (Lt, "lt", "<"), (Le, "le", "<="))


class ConfigError(ValueError):
    """Options that cannot be used; the message names every wrong entry, what was expected and what came."""


def option(
    default: Any,
    meaning: str,
    *,
    unit: str = "",
    group: str = "",
    basic: bool = False,
    flag: str = "",
    metavar: str = "",
    old: tuple[str, ...] = (),
    exists: bool = False,
    repeated: bool = False,
    **bounds: float,
) -> Any:
    """A field of a `Section`.

    Args:
        default: value where nothing is said.
        meaning: one phrase for a person.
        unit: of a number, `metres` for example.
        group: heading under which the option is listed; the section's if not given.
        basic: whether most people need it; all others are listed as advanced.
        flag: on the command line; by default the field's name with hyphens.
        metavar: what stands behind the flag in the help.
        old: former names of the entry, which files are read by and flags are refused by.
        exists: whether a path must be there.
        repeated: whether a text is given in several flags, which ' + ' joins.
        bounds: `gt`, `ge`, `lt`, `le` of a number.
    """
    more: dict[str, Any] = {
        "unit": unit,
        "group": group,
        "basic": basic,
        "flag": flag,
        "metavar": metavar,
        "old": list(old),
    }
    limits: dict[str, Any] = bounds
    return Field(
        default, description=meaning, json_schema_extra={**more, "exists": exists, "repeated": repeated}, **limits
    )


def part(section: type[Section], *, old: tuple[str, ...] = ()) -> Any:
    """A field that is a section of its own, at its defaults.

    Args:
        section: its class.
        old: former names of it.
    """
    return Field(default_factory=section, json_schema_extra={"old": list(old)})


class Section(BaseModel):
    """Options that belong together. Entries under a former name are read; those of no name are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    group: ClassVar[str] = "input"

    @model_validator(mode="before")
    @classmethod
    def _former_names(cls, entries: Any) -> Any:
        if not isinstance(entries, dict):
            return entries
        renamed = former_names(cls)
        both = [(old, renamed[old]) for old in entries if old in renamed and renamed[old] in entries]
        if both:
            old, new = both[0]
            raise ValueError(f"{old}: is called {new} now, expected one of them, got both")
        return {renamed.get(name, name): value for name, value in entries.items()}


def former_names(section: type[BaseModel]) -> dict[str, str]:
    """Former names of a section's entries, and what each is called now."""
    return {old: name for name, field in section.model_fields.items() for old in _more(field).get("old", ())}


def _more(field: FieldInfo) -> dict[str, Any]:
    extra = field.json_schema_extra
    return dict(extra) if isinstance(extra, dict) else {}


@dataclass(frozen=True)
class Option:
    """One entry of a section as a person reads it.

    Args:
        name: of the field.
        section: its class.
        field: as pydantic holds it.
    """

    name: str
    section: type[Section]
    field: FieldInfo

    @property
    def meaning(self) -> str:
        """One phrase."""
        return self.field.description or ""

    @property
    def default(self) -> Any:
        """Value where nothing is said."""
        return self.field.get_default(call_default_factory=True)

    @property
    def unit(self) -> str:
        """Of a number; empty where there is none."""
        return str(_more(self.field).get("unit", ""))

    @property
    def group(self) -> str:
        """Heading under which it is listed."""
        return str(_more(self.field).get("group") or self.section.group)

    @property
    def is_advanced(self) -> bool:
        """Whether most people do without it."""
        return not _more(self.field).get("basic", False)

    @property
    def flag(self) -> str:
        """On the command line."""
        return str(_more(self.field).get("flag") or f"--{self.name.replace('_', '-')}")

    @property
    def former_flags(self) -> list[str]:
        """What the flag was called before."""
        return [f"--{old.replace('_', '-')}" for old in _more(self.field).get("old", ())]

    @property
    def metavar(self) -> str:
        """What stands behind the flag in the help; empty for what click says."""
        return str(_more(self.field).get("metavar", ""))

    @property
    def must_exist(self) -> bool:
        """Whether it is a path of something that is there."""
        return bool(_more(self.field).get("exists", False))

    @property
    def is_repeated(self) -> bool:
        """Whether its flag may stand several times."""
        return bool(_more(self.field).get("repeated", False)) or get_origin(self.type) is dict or self.is_list

    @property
    def is_list(self) -> bool:
        """Whether it holds any number of values."""
        return get_origin(self.type) is tuple and get_args(self.type)[-1] is Ellipsis

    @property
    def count(self) -> int:
        """How many values stand behind its flag."""
        return len(get_args(self.type)) if get_origin(self.type) is tuple and not self.is_list else 1

    @property
    def type(self) -> Any:
        """The annotation without `None`."""
        kind = self.field.annotation
        if get_origin(kind) in (Union, UnionType):
            rest = [part for part in get_args(kind) if part is not NoneType]
            return rest[0] if len(rest) == 1 else kind
        return kind

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that it may be; empty for anything else."""
        kind = get_args(self.type)[0] if self.is_list else self.type
        return get_args(kind) if get_origin(kind) is Literal else ()

    @property
    def bounds(self) -> str:
        """Allowed range of a number, `> 0 and < 0.5`; empty where there is none."""
        found = [
            f"{sign} {getattr(limit, name):g}"
            for kind, name, sign in _BOUNDS
            for limit in self.field.metadata
            if isinstance(limit, kind)
        ]
        return " and ".join(found)

    @property
    def allowed(self) -> str:
        """Choices, or range, then the unit, `> 0; metres`; empty where anything goes."""
        words = " | ".join(repr(word) if word == "" else word for word in self.choices)
        return "; ".join(filter(None, (words or self.bounds, self.unit)))

    @property
    def expected(self) -> str:
        """What a value has to be, as a message says it; empty where only pydantic knows."""
        unit = f", in {self.unit}" if self.unit else ""
        if self.choices and not self.is_list:
            return "one of " + ", ".join(word or "''" for word in self.choices)
        if self.type in (int, float):
            kind = "a whole number" if self.type is int else "a finite number"
            return f"{kind}{f' {self.bounds}' if self.bounds else ''}{unit}"
        return {bool: "true or false", str: "text"}.get(self.type, "")

    def check(self, value: Any, key: str) -> Any:
        """The value as the schema holds it.

        Args:
            value: as it came.
            key: what the message calls it: a flag, or an entry of organ.toml.

        Raises:
            ConfigError: it is none that the schema allows.
        """
        try:
            return _adapter(self).validate_python(value)
        except ValidationError as error:
            raise ConfigError(f"{key}: {said_of(error.errors()[0], self)}.") from None


def _adapter(option: Option) -> TypeAdapter[Any]:
    kind: Any = option.field.annotation
    limits = tuple(option.field.metadata)
    held: Any = Annotated[(kind, *limits)] if limits else kind
    return TypeAdapter(held, config=ConfigDict(allow_inf_nan=False))


def said_of(error: Any, option: Option | None) -> str:
    """One error of pydantic for a person: what was expected, and what came."""
    came = reprlib.repr(error["input"])
    if error["type"] == "value_error":
        return f"{error['msg'].removeprefix('Value error, ')}, got {came}"
    if option is not None and option.expected:
        return f"expected {option.expected}, got {came}"
    return f"{error['msg']}, got {came}"


def options_of(section: type[Section]) -> Iterator[Option]:
    """The entries of a section, without sections inside, in their order."""
    for name, field in section.model_fields.items():
        if not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            yield Option(name, section, field)


def option_of(section: type[Section], name: str) -> Option:
    """The entry of that name."""
    return Option(name, section, section.model_fields[name])


def described(root: type[Section], error: Any) -> str:
    """One error in a tree of sections for a person: which entry, what was expected, what came.

    Args:
        root: class of the whole.
        error: one of pydantic's `ValidationError.errors()`.
    """
    place, holder = list(map(str, error["loc"])), root
    for depth, name in enumerate(place):
        field = holder.model_fields.get(name)
        if field is None:
            return _unheard_of(place, holder, name, error)
        if not (isinstance(field.annotation, type) and issubclass(field.annotation, Section)):
            option = Option(name, holder, field) if depth == len(place) - 1 else None
            return f"{'.'.join(place)}: {said_of(error, option)}"
        holder = field.annotation
    if error["type"] == "value_error":  # of a whole section: the message names the entry and what came
        return str(error["msg"].removeprefix("Value error, "))
    return f"{'.'.join(place) or 'configuration'}: expected a table of entries, got {reprlib.repr(error['input'])}"


def _unheard_of(place: list[str], holder: type[Section], name: str, error: Any) -> str:
    near = difflib.get_close_matches(name, holder.model_fields, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"{'.'.join(place)}: there is no such entry{hint}, got {reprlib.repr(error['input'])}"
