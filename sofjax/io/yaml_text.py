"""YAML that cannot run code, nor unfold without end."""

import yaml

from sofjax.io.errors import InputError

MAX_DEPTH = 20


class _Loader(yaml.SafeLoader):
    """Plain data alone: no tags that build objects, no aliases, no name given twice."""

    depth = 0

    def compose_node(self, parent, index):
        if self.check_event(yaml.AliasEvent) or self.peek_event().anchor is not None:
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(
                problem="anchors (&) and aliases (*) are not allowed; write the value out",
                problem_mark=mark,
            )
        self.depth += 1
        if self.depth > MAX_DEPTH:
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(problem="nested too deep", problem_mark=mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node, deep=False):
        mapping = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            problem = "a name is given twice"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        return mapping


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.construct_yaml_map)


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
        raise InputError(f"{where}{line}: not plain YAML: {error.problem}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{where}: not plain YAML: {first}") from None
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
