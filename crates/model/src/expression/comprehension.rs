//! Comprehensions: one expression, evaluated for every element of a list.
//!
//! ```text
//! filter($box in boxes, $box.size[0] < 0.1)
//! min_by($box in boxes, distance($box.pose, pose(0, 0, 0)))
//! ```
//!
//! The element's name hides nothing, because the parser refuses a name that is already visible. The number of elements that one
//! evaluation visits is bounded, including those of nested comprehensions.

use super::evaluate::{EvaluateError, described, order};
use super::query::MAX_STEPS;
use super::scope::{Scope, WithElement};
use super::{Expr, function};
use crate::value::Value;
use serde::{Deserialize, Serialize};
use std::cell::Cell;

/// One element costs as much of the bound as this number of facts in a query.
const STEPS_PER_ELEMENT: u64 = 10;

/// The kinds of comprehensions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Comprehension {
    /// The list of the body's values.
    Map,
    /// The elements for which the condition holds.
    Filter,
    /// The elements in increasing order of their values; elements with equal values keep their order.
    SortBy,
    /// The first element with the smallest value; null for an empty list.
    MinBy,
    /// The first element with the greatest value; null for an empty list.
    MaxBy,
    /// Whether the condition holds for any element.
    Any,
    /// Whether the condition holds for every element.
    All,
}

impl Comprehension {
    /// All kinds.
    pub const ALL: [Comprehension; 7] = [
        Comprehension::Map,
        Comprehension::Filter,
        Comprehension::SortBy,
        Comprehension::MinBy,
        Comprehension::MaxBy,
        Comprehension::Any,
        Comprehension::All,
    ];

    /// Its name in an expression.
    pub fn name(self) -> &'static str {
        match self {
            Comprehension::Map => "map",
            Comprehension::Filter => "filter",
            Comprehension::SortBy => "sort_by",
            Comprehension::MinBy => "min_by",
            Comprehension::MaxBy => "max_by",
            Comprehension::Any => "any",
            Comprehension::All => "all",
        }
    }

    /// Its usage.
    pub fn usage(self) -> &'static str {
        match self {
            Comprehension::Map => "map($x in list, value)",
            Comprehension::Filter => "filter($x in list, condition)",
            Comprehension::SortBy => "sort_by($x in list, key)",
            Comprehension::MinBy => "min_by($x in list, key)",
            Comprehension::MaxBy => "max_by($x in list, key)",
            Comprehension::Any => "any($x in list, condition)",
            Comprehension::All => "all($x in list, condition)",
        }
    }

    /// The comprehension with this name.
    pub fn named(name: &str) -> Option<Comprehension> {
        Comprehension::ALL.into_iter().find(|comprehension| comprehension.name() == name)
    }

    /// Whether its body is a condition.
    pub(crate) fn asks(self) -> bool {
        matches!(self, Comprehension::Filter | Comprehension::Any | Comprehension::All)
    }
}

/// Evaluates the comprehension `whole`, which has these parts.
///
/// # Errors
/// As [`Expr::evaluate`]; also if the list is no list, if keys cannot be ordered, and if there are more elements than the bound.
pub(super) fn evaluate(
    whole: &Expr,
    (what, name): (Comprehension, &str),
    (list, body): (&Expr, &Expr),
    scope: &dyn Scope,
) -> Result<Value, EvaluateError> {
    let of = list.value(scope)?;
    let Value::List(items) = of.as_ref() else {
        return Err(list.wrong(format!("expected a list, found {}", described(&of))));
    };
    let own = Cell::new(MAX_STEPS);
    let left = scope.budget().unwrap_or(&own);
    let spend = || {
        let rest = left.get().checked_sub(STEPS_PER_ELEMENT);
        left.set(rest.ok_or_else(|| whole.wrong("it looks at too many elements; shorten the lists"))?);
        Ok(())
    };
    let within = |value| WithElement { outer: scope, name, value, left };
    let holds = |item| spend().and_then(|()| body.holds(&within(item)));
    let key = |item| spend().and_then(|()| body.evaluate(&within(item)));
    let ordered = |problem: String| whole.wrong(problem);
    Ok(match what {
        Comprehension::Map => Value::List(items.iter().map(key).collect::<Result<_, _>>()?),
        Comprehension::Filter => {
            let kept = items.iter().filter_map(|item| holds(item).map(|holds| holds.then(|| item.clone())).transpose());
            Value::List(kept.collect::<Result<_, _>>()?)
        }
        Comprehension::SortBy => {
            let keyed = items.iter().map(|item| Ok((key(item)?, item.clone())));
            Value::List(function::sorted(keyed.collect::<Result<_, EvaluateError>>()?).map_err(ordered)?.into())
        }
        Comprehension::MinBy | Comprehension::MaxBy => {
            let mut best: Option<(Value, &Value)> = None;
            for item in items {
                let key = key(item)?;
                let compared = order(&key, best.as_ref().map_or(&key, |(best, _)| best)).map_err(ordered)?;
                let better = if what == Comprehension::MinBy { compared.is_lt() } else { compared.is_gt() };
                if best.is_none() || better {
                    best = Some((key, item));
                }
            }
            best.map_or(Value::Null, |(_, item)| item.clone())
        }
        Comprehension::Any | Comprehension::All => {
            let decides = what == Comprehension::Any;
            for item in items {
                if holds(item)? == decides {
                    return Ok(Value::Bool(decides));
                }
            }
            Value::Bool(!decides)
        }
    })
}

#[cfg(test)]
mod tests {
    use super::super::parse::{NameError, Names, parse_expression};
    use super::*;
    use crate::expression::scope::NothingKnown;
    use crate::id::StateId;

    /// A scope with `$box` and the state `see` with its port `boxes`.
    struct Known;

    impl Names for Known {
        fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
            let unknown = NameError { rule: "unknown-variable", message: format!("no `${name}`"), help: String::new() };
            if name == "box" { Ok(Expr::Variable(name.to_owned())) } else { Err(unknown) }
        }

        fn word(&mut self, _: &str) -> Option<Expr> {
            None
        }

        fn port(&mut self, _: &str, port: &str) -> Result<Expr, NameError> {
            Ok(Expr::Port { state: StateId(1), port: port.to_owned() })
        }
    }

    fn of(text: &str) -> String {
        match parse_expression(text, &mut Known).map(|expr| expr.evaluate(&NothingKnown)) {
            Ok(Ok(value)) => value.to_string(),
            Ok(Err(error)) => error.to_string(),
            Err(error) => format!("{} at {}", error.message, error.offset),
        }
    }

    #[test]
    fn each_makes_of_a_list_what_its_name_says() {
        assert_eq!(of("map($x in [1, 2, 3], $x * $x)"), "[1, 4, 9]");
        assert_eq!(of("filter($x in range(6), $x > 3)"), "[4, 5]");
        assert_eq!(of("sort_by($x in [3, 1, 2], -$x)"), "[3, 2, 1]");
        assert_eq!(of("sort_by($x in ['bb', 'a', 'cc'], len($x))"), "[a, bb, cc]");
        assert_eq!(of("min_by($x in [{n: 2, id: a}, {n: 1, id: b}, {n: 1, id: c}], $x.n).id"), "b");
        assert_eq!(of("max_by($x in [{n: 2, id: a}, {n: 1, id: b}, {n: 2, id: c}], $x.n).id"), "a");
        assert_eq!(of("any($x in [1, 2], $x = 2)"), "true");
        assert_eq!(of("all($x in [1, 2], $x = 2)"), "false");
        assert_eq!(of("map($x in [1, 2], map($y in [10, 20], $x + $y))"), "[[11, 21], [12, 22]]");
        assert_eq!(of("min_by($p in [pose(2, 0, 0), pose(0, 1, 0)], distance($p, pose(0, 0, 0))).y"), "1");
    }

    #[test]
    fn of_an_empty_list_nothing_is_the_best_and_everything_holds() {
        assert_eq!(of("min_by($x in [], $x)"), "null");
        assert_eq!(of("any($x in [], $x)"), "false");
        assert_eq!(of("all($x in [], $x)"), "true");
        assert_eq!(of("sort_by($x in [], $x)"), "[]");
    }

    #[test]
    fn what_is_wrong_is_said() {
        let usage = "expected `filter($x in list, condition)`";
        assert_eq!(of("filter([1], true)"), format!("{usage} at 0"));
        assert_eq!(of("filter($x in [1])"), format!("{usage} at 0"));
        assert_eq!(of("filter($x, [1], $x)"), format!("{usage} at 0"));
        assert_eq!(
            of("map($box in [1], $box)"),
            "`$box` has a meaning here already; give the element another name at 4"
        );
        assert_eq!(
            of("map($x in [1], map($x in [2], $x))"),
            "`$x` has a meaning here already; give the element another name at 19"
        );
        assert_eq!(of("map($x in [1], 1) + $x"), "no `$x` at 20");
        assert_eq!(of("map($x in 1, $x)"), "`1`: expected a list, found int 1");
        assert_eq!(of("filter($x in [1], $x)"), "`$x`: expected true or false, found int 1");
        assert_eq!(of("sort_by($x in [1, a], $x)"), "`sort_by($x in [1, a], $x)`: expected a number, found string `a`");
        assert_eq!(of("min_by($x in [[1]], $x)"), "`min_by($x in [[1]], $x)`: expected a number, found a list");
    }

    #[test]
    fn the_elements_of_one_evaluation_are_bounded() {
        let nested = "any($x in range(1000), any($y in range(1000), $x + $y < 0))";
        assert!(of(nested).contains("too many elements"), "{}", of(nested));
        assert_eq!(of("len(map($x in range(100000), $x))"), "100000");
    }

    #[test]
    fn it_prints_as_it_is_read() {
        for text in
            ["min_by($x in see.boxes, $x.n + $box)", "filter($x in [1, 2], exists at($x) and all($y in $x, $y))"]
        {
            let parsed = parse_expression(text, &mut Known);
            let printed = parsed.clone().map(|expr| expr.to_string().replace("s1.", "see."));
            assert_eq!(printed.as_deref(), Ok(text));
            assert_eq!(parse_expression(text, &mut Known), parsed);
        }
    }
}
