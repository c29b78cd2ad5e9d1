"""The changes that are made: comparisons, +-1, signs, and/or, not, constants, statements and rows left out."""

import ast
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

SWAPS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.Mod: (ast.FloorDiv,),
    ast.FloorDiv: (ast.Mod,),
    ast.LShift: (ast.RShift,),
    ast.RShift: (ast.LShift,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.BitXor: (ast.BitOr,),
}
NAMES = {"min": "max", "max": "min"}
LEAVES = (ast.Assign, ast.AugAssign, ast.Expr, ast.Return, ast.Continue, ast.Break, ast.Raise)


class Mutant(NamedTuple):
    """One change of a source."""

    scope: str  # dotted name of the function or class, '' for the module
    line: int  # where it is, from 1
    last: int  # line where what is changed ends
    start: int  # offsets of what is changed, in characters
    end: int
    was: str
    becomes: str
    number: int  # among those of this scope with the same text

    @property
    def key(self) -> str:
        """What tells it from all others of its file, wherever the lines move."""
        return f"{self.scope}: {self.was} -> {self.becomes} #{self.number}"

    def applied(self, source: str) -> str:
        """Return the source with the change."""
        return source[: self.start] + self.becomes + source[self.end :]


def mutants(source: str) -> list[Mutant]:
    """Return every change of a module, in the order of its lines."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def offset(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    found, seen = [], Counter[tuple[str, str, str]]()
    for scope, first, node, becomes in _changes(ast.parse(source), "", False):
        start, end = offset(first.lineno, first.col_offset), offset(node.end_lineno or 0, node.end_col_offset or 0)
        if not becomes:
            rest = source[end:].lstrip()
            end = len(source) - len(rest) + 1 if rest.startswith(",") else end
        was = source[start:end]
        if was != becomes:
            seen[scope, was, becomes] += 1
            number = seen[scope, was, becomes]
            found.append(Mutant(scope, first.lineno, node.end_lineno or 0, start, end, was, becomes, number))
    return sorted(found, key=lambda m: (m.start, m.end, m.becomes))


_Node: TypeAlias = ast.expr | ast.stmt
_Change: TypeAlias = tuple[str, _Node, _Node, str]


def _changes(node: ast.AST, scope: str, inside: bool) -> Iterator[_Change]:
    """Yield each change in a tree: scope, first and last node, new text, '' to leave out; inside: of a function."""
    if isinstance(node, ast.JoinedStr):
        return  # what is told
    if isinstance(node, ast.expr):
        for text in _of_expression(node):
            yield scope, node, node, text
        for first, last in _rows(node) if not inside else ():
            yield scope, first, last, ""
    elif isinstance(node, LEAVES):
        for text in _of_statement(node, inside):
            yield scope, node, node, text
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        test = node.test
        if not isinstance(test, ast.Compare | ast.BoolOp | ast.UnaryOp | ast.Constant):
            yield scope, test, test, f"(not ({ast.unparse(test)}))"
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
        return  # of a vector, the first axis is the last, and there is no other
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "bases"):
            continue
        within, inner = scope, inside
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and name == "body":
            within = f"{scope}.{node.name}".lstrip(".")
            inner = inside or isinstance(node, ast.FunctionDef)
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _changes(child, within, inner)


def _of_expression(node: ast.expr) -> Iterator[str]:
    """Yield what an expression may become."""
    match node:
        case ast.Compare(ops=[*ops]):
            for i, op in enumerate(ops):
                for other in SWAPS[type(op)]:
                    yield _with(node, ops=[*ops[:i], other(), *ops[i + 1 :]])
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in SWAPS:
            for other in SWAPS[type(op)]:
                yield _with(node, op=other())
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield f"({ast.unparse(operand)})"
        case ast.Constant(value=bool() as value):
            yield str(not value)
        case ast.Constant(value=int() as value):
            yield f"({value + 1})"
            yield f"({value - 1})"
        case ast.Constant(value=float() as value):
            yield f"({value + 1.0!r})"
            if value:
                yield f"({value * 1.01!r})"
        case ast.Call(func=ast.Name(id="min" | "max" as name)):
            yield _with(node, func=ast.Name(NAMES[name], ast.Load()))


def _rows(node: ast.expr) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Yield first and last node of each row of a table; the fields of a row are none."""
    if isinstance(node, ast.Dict) and len(node.keys) > 1:
        yield from ((key, value) for key, value in zip(node.keys, node.values, strict=True) if key)
    elif isinstance(node, ast.Tuple | ast.Set) and any(isinstance(one, ast.Call | ast.Tuple) for one in node.elts):
        yield from ((one, one) for one in node.elts if len(node.elts) > 1)


def _of_statement(node: ast.stmt, inside: bool) -> Iterator[str]:
    """Yield what a statement may become; left out, only in a function."""
    if isinstance(node, ast.AugAssign) and type(node.op) in SWAPS:
        for other in SWAPS[type(node.op)]:
            yield _with(node, op=other())
    told = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant | ast.Yield)  # a docstring
    if inside and not told:
        yield "pass"


def _with(node: ast.AST, **fields: object) -> str:
    """Return the text of a node with some of its fields replaced, in brackets if it is an expression."""
    values = {name: getattr(node, name) for name in node._fields} | fields
    text = ast.unparse(ast.fix_missing_locations(type(node)(**values)))
    return f"({text})" if isinstance(node, ast.expr) else text
