"""Pydantic rules for the keys of scene files (numbers with units and ranges, words, values by joint), and messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    PlainValidator,
    StrictBool,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, core_schema

from varpin.io.scenefile.table import SceneFileError, inside, shown, suggestion
from varpin.support.checks import is_file


class Keys(BaseModel):
    """A table of a scene file. Its keys are the fields; other keys are errors."""

    model_config = ConfigDict(frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _require_keys(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            raise ValueError(f"must be a table, got {shown(table)}")
        for name in table:
            if name not in cls.model_fields:
                raise mistake(name, f"unknown key; {suggestion(name, cls.model_fields, 'keys')}")
        for name, field in cls.model_fields.items():
            if field.is_required() and name not in table:
                what = "".join(f"; {rule.what} belongs here" for rule in field.metadata if isinstance(rule, Rule))
                raise mistake(name, f"is missing{what}")
        return table


K = TypeVar("K", bound=Keys)


@dataclass(frozen=True)
class Rule:
    """The allowed values of a key, as the annotation of its field.

    Attributes:
        kind: The type for pydantic.
        what: The allowed values in words, for messages.
        parts: Whether parts of the value have rules and messages of their own.
    """

    kind: Any
    what: str
    parts: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler.generate_schema(self.kind)
        if self.parts:
            return schema
        context = {"what": self.what}
        return core_schema.custom_error_schema(
            schema, "rule", custom_error_message="{what}", custom_error_context=context
        )


def number(
    unit: str = "", *, above: float | None = None, least: float | None = None, most: float | None = None
) -> Rule:
    """A finite number > ``above``, >= ``least`` and <= ``most``."""
    bounds = [f"{sign} {bound:g}" for sign, bound in ((">", above), (">=", least), ("<=", most)) if bound is not None]
    what = f"a finite number{' ' if bounds else ''}{' and '.join(bounds)}{_unit(unit)}"
    return Rule(Annotated[float, Field(strict=True, allow_inf_nan=False, gt=above, ge=least, le=most)], what)


def whole(least: int = 0, most: int | None = None) -> Rule:
    """An integer >= ``least`` and <= ``most``."""
    what = f"an integer >= {least}{'' if most is None else f' and <= {most}'}"
    return Rule(Annotated[int, Field(strict=True, ge=least, le=2**63 - 1 if most is None else most)], what)


FLAG = Rule(StrictBool, "true or false")
TEXT = Rule(Annotated[str, Field(strict=True, pattern=r"^[^\x00]*[^\x00\s][^\x00]*$")], "a text in quotes")


def word(*options: str) -> Rule:
    """One of the strings ``options``."""

    def known(value: Any) -> str:
        if not isinstance(value, str):
            raise ValueError(f"must be one of {', '.join(options)}, got {shown(value)}")
        if value not in options:
            raise ValueError(f"there is no {value!r}; {suggestion(value, options, 'allowed')}")
        return value

    return Rule(Annotated[str, PlainValidator(known)], f"one of {', '.join(options)}", parts=True)


def numbers(length: int | None = None, unit: str = "") -> Rule:
    """A list of finite numbers, of a given length if any."""
    kind = Annotated[tuple[Annotated[float, number(unit)], ...], Field(min_length=length, max_length=length)]
    return Rule(kind, f"a list of {'' if length is None else f'{length} '}numbers{_unit(unit)}", parts=True)


def values(unit: str = "", *, least: float | None = None, **others: Any) -> Rule:
    """One number for all, a list with one for each, or a table by name; or one of the kinds ``others``."""
    scalar = Annotated[float, number(unit, least=least)]
    what = f"a number for all, a list, or a table by name{_unit(unit)}"
    return either(what, **{"number": scalar, "list": tuple[scalar, ...], "table": dict[str, scalar], **others})


def either(what: str, shape: Callable[[Any], str] | None = None, **kinds: Any) -> Rule:
    """One of several kinds, selected by the ``shape`` of a value, which is its TOML type if left out."""
    readers = {name: TypeAdapter(kind) for name, kind in kinds.items()}

    def chosen(value: Any, info: ValidationInfo) -> Any:
        found = (shape or toml_type)(value)
        if found not in readers:
            raise ValueError(f"must be {what}, got {shown(value)}")
        return readers[found].validate_python(value, context=info.context)

    return Rule(Annotated[Any, PlainValidator(chosen)], what, parts=True)


def checked(kind: Any, check: Callable[..., Any]) -> Rule:
    """A value of a kind, converted by ``check``, which raises a ValueError for wrong ones."""
    plain, what = (Annotated[Any, kind], kind.what) if isinstance(kind, Rule) else (kind, "")
    return Rule(Annotated[plain, AfterValidator(check)], what, parts=True)


def beside(text: str, info: ValidationInfo) -> Path:
    """A path in a scene file; a relative one must be below the folder of the file."""
    context: Any = info.context
    return inside(text, context["folder"], "the scene's folder")


def existing(path: Path) -> Path:
    """The path of a file, which must exist."""
    if not is_file(path):
        raise ValueError(f"there is no file {path}")
    return path


def existing_file(text: str, info: ValidationInfo) -> Path:
    """The path of an existing file, by :func:`beside`."""
    return existing(beside(text, info))


def typed(kinds: Mapping[str, type[Keys]], default: str | None = None) -> Rule:
    """A table of one of several kinds, selected by its key ``type``."""
    options = f"one of {', '.join(kinds)}"

    def chosen(table: Any, info: ValidationInfo) -> Keys:
        if not isinstance(table, dict):
            raise ValueError(f"must be a table, got {shown(table)}")
        kind = table.get("type", default)
        if kind is None:
            raise mistake("type", f"is missing; {options} belongs here")
        if not isinstance(kind, str):
            raise mistake("type", f"must be {options}, got {shown(kind)}")
        if kind not in kinds:
            raise mistake("type", f"there is no {kind!r}; {suggestion(kind, kinds, 'allowed')}")
        return kinds[kind].model_validate(table, context=info.context)

    return Rule(Annotated[Any, PlainValidator(chosen)], "a table", parts=True)


def toml_type(value: Any) -> str:
    """The name of a value's type; ``"other"`` for types that no key takes."""
    names = {bool: "flag", str: "text", list: "list", dict: "table", int: "number", float: "number"}
    return names.get(type(value), "other")


def _unit(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def mistake(key: str | int, problem: str) -> ValidationError:
    """An error at a key of a table, for validators to raise."""
    error = PydanticCustomError("mistake", "{problem}", {"problem": problem})
    return ValidationError.from_exception_data("scene", [InitErrorDetails(type=error, loc=(key,), input=None)])


def read_keys(kind: type[K], data: Any, path: Path) -> K:
    """Validate the tables of the file ``path``.

    Raises:
        SceneFileError: The first mistake in them.
    """
    try:
        return kind.model_validate(data, context={"folder": path.resolve().parent})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    value, context = first["input"], first.get("ctx", {})
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).removeprefix(".")
    problems = {
        "mistake": first["msg"],
        "value_error": str(context.get("error")),
        "rule": f"must be {first['msg']}, got {shown(value)}",
        "too_short": f"must have {context.get('min_length')} entries, got {context.get('actual_length')}",
        "too_long": f"must have {context.get('max_length')} entries, got {context.get('actual_length')}",
        "dict_type": f"must be a table, got {shown(value)}",
        "tuple_type": f"must be a list, got {shown(value)}; tables in a list are written [[{key}]]",
    }
    problem = problems.get(first["type"], f"{first['msg']}, got {shown(value)}")
    raise SceneFileError(path.name, key, problem)
