"""YAML that cannot run code, nor unfold without end."""

import re
from collections.abc import Hashable
from typing import Any, ClassVar

import yaml

from sofjax.io.errors import InputError, plain, quoted

MAX_DEPTH = 20
OPENCV = "tag:yaml.org,2002:opencv-matrix"


class _Loader(yaml.SafeLoader):
    """Plain data alone: no tags, no aliases, no name given twice.

    Numbers are decimal: in YAML 1.1 5:20 is 320, 017 is 15 and `no` is false.
    """

    depth = 0
    yaml_implicit_resolvers: ClassVar[dict] = {}  # none of YAML 1.1; those below

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent) or self.peek_event().anchor is not None:
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(
                problem="anchors (&) and aliases (*) are not allowed; write the value out",
                problem_mark=mark,
            )
        event = self.peek_event()
        tag = getattr(event, "tag", None)
        if tag not in (None, "!", OPENCV):
            raise yaml.MarkedYAMLError(
                problem=f"the tag {quoted(tag)} is not allowed", problem_mark=event.start_mark
            )
        self.depth += 1
        if self.depth > MAX_DEPTH:
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(problem="nested too deep", problem_mark=mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        mapping = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            problem = "a name is given twice"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        return mapping


_Loader.add_constructor(OPENCV, _Loader.construct_yaml_map)
for _kind, _form in {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?(0|[1-9][0-9]*)",
    "float": r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
    r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
}.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(f"({_form})$"), None)


def parse_yaml(text: str, where: str) -> object:
    """The data of a YAML text; `where` names the file in the sentence of the error.

    OpenCV's header and its tag of a matrix are passed over. Documents that `---` parts are taken
    together if no name is in two of them: ROS ends a message by it, and a user adds to that.
    """
    if text.startswith("%YAML:"):  # of OpenCV, and no YAML
        text = f"#{text}"
    try:
        documents = list(yaml.load_all(text, Loader=_Loader))  # a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        raise InputError(f"{where}{line}: not plain YAML: {plain(str(error.problem))}") from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{where}: not plain YAML: {plain(error)}") from None
    documents = [data for data in documents if data is not None]
    if len(documents) > 1 and all(isinstance(data, dict) for data in documents):
        joined = {key: value for data in documents for key, value in data.items()}
        if len(joined) == sum(map(len, documents)):
            return joined
    if len(documents) > 1:
        raise InputError(
            f"{where}: {len(documents)} documents parted by '---' have the same names; keep one"
        )
    return documents[0] if documents else None
