"""Nested options from flat ones, as the command line spells them."""

from __future__ import annotations

from dataclasses import fields

from triform.control import ControllerSpec
from triform.evaluation.events import Event
from triform.evaluation.overrides import Overrides
from triform.evaluation.runs import Execution
from triform.evaluation.scenario import Scenario


def _part(kind, given):
    names = {each.name for each in fields(kind)}
    return {name: given.pop(name) for name in list(given) if name in names}


def scenario(**given):
    overrides = Overrides(**_part(Overrides, given))
    if isinstance(given.get("event"), str):
        given["event"] = Event.parse(given["event"])
    return Scenario(overrides=overrides, **given)


def options(kind, **given):
    """Return options of ``kind``, such as ``EvaluateConfig``, from flat ones."""
    if isinstance(given.get("controller"), str):
        given["controller"] = ControllerSpec.parse(given["controller"])
    if "controllers" in given:
        given["controllers"] = tuple(map(ControllerSpec.parse, given["controllers"]))
    own = _part(kind, given)
    if "execution" in {each.name for each in fields(kind)}:
        own["execution"] = Execution(**_part(Execution, given))
    return kind(scenario=scenario(**given), **own)
