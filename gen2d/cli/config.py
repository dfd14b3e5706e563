"""Show a config with every option, check configs, or print their JSON Schema for editors."""

import argparse
import json

from gen2d.cli.parser import Parser, add_overrides
from gen2d.config.plugins import nearest
from gen2d.core.errors import ConfigError, UserError, one_line

ACTIONS = ["show", "check", "schema"]


def add_arguments(parser: Parser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "action",
        metavar="ACTION",
        help="show: one config with all its options, as YAML that runs again; check: a line for each config, with the "
        "limits of the solver that it exceeds, and exit code 2 if one is invalid; schema: the JSON Schema of configs, "
        "or of those of one scene family",
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="the config (show), configs (check) or scene family (schema)"
    )
    add_overrides(parser)
    parser.add_argument(
        "--no-comments", action="store_false", dest="comments", help="show options without their units and meanings"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Print what is asked for of configs; the exit code of the verb."""
    action, names = options.action, options.names
    if action not in ACTIONS:
        raise UserError(f"config {action!r} is not an action; {nearest(action, ACTIONS)}")
    limits = {"show": (1, 1, "one config"), "check": (1, None, "one config or more"), "schema": (0, 1, "one family")}
    least, most, noun = limits[action]
    if len(names) < least or (most is not None and len(names) > most):
        raise UserError(f"config {action} has {len(names)} names, but must have {noun}, such as bouncing")
    if action == "schema":
        if options.overrides:
            raise UserError("--set changes a config, but config schema is of all configs")
        from gen2d.config.json_schema import json_schema

        print(json.dumps(json_schema(*names), indent=1))
        return 0
    from gen2d.config.config import load_config
    from gen2d.config.resolved import resolved, resolved_text

    if action == "show":
        config = load_config(names[0], options.overrides)
        text = json.dumps(resolved(config)) if options.json else resolved_text(config, options.comments)
        print(text.rstrip("\n"))
        return 0
    from gen2d.programs.limits import exceeded_limits

    problems: dict[str, str | None] = {}
    for name in names:
        warnings = list[str]()
        try:
            warnings = exceeded_limits(load_config(name, options.overrides))
            problems[name] = None
        except ConfigError as error:
            problems[name] = str(error)
        if options.json:
            values = {"config": name, "valid": problems[name] is None, "problem": problems[name]}
            print(json.dumps(values | {"warnings": warnings}))
        else:
            print(problems[name] or one_line("; ".join([f"{name}: valid", *warnings])))
    return 2 if any(problems.values()) else 0
