//! Conditions on the attributes of a resource: `payload >= 2.5`, `tool in [gripper, welder]`, `has camera`.
//!
//! Comparisons have the same meaning as in expressions. A missing attribute satisfies no condition, not even `!=`; nor does an
//! attribute that cannot be compared. `host` is the host of the resource, unless the resource has an attribute of that name.

use crate::expression::evaluate::compare;
use crate::expression::parse::parse_expression;
use crate::expression::scope::NothingKnown;
use crate::expression::{BinaryOperator, EvaluateError, Expr, Scope};
use crate::parameters::NoNames;
use crate::value::Value;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The comparison of an attribute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Comparison {
    /// `=`, exact, with ints and floats as numbers.
    Equal,
    /// `!=`
    NotEqual,
    /// `<`, of numbers or of texts.
    Less,
    /// `<=`
    LessOrEqual,
    /// `>`
    Greater,
    /// `>=`
    GreaterOrEqual,
    /// `in` a list.
    In,
    /// `has`: the attribute exists, whatever its value.
    Has,
}

/// A condition on one attribute.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Condition {
    /// The attribute's name.
    pub attribute: String,
    /// The comparison.
    pub comparison: Comparison,
    /// The value to compare with; null for [`Comparison::Has`], a list for [`Comparison::In`].
    pub value: Value,
}

/// A condition as written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConditionExpr {
    /// The attribute's name.
    pub attribute: String,
    /// The comparison.
    pub comparison: Comparison,
    /// The value to compare with; null for [`Comparison::Has`].
    pub value: Expr,
}

impl Comparison {
    /// All comparisons, each with its symbol or word.
    pub const WRITTEN: [(&'static str, Comparison); 8] = [
        ("=", Comparison::Equal),
        ("!=", Comparison::NotEqual),
        ("<", Comparison::Less),
        ("<=", Comparison::LessOrEqual),
        (">", Comparison::Greater),
        (">=", Comparison::GreaterOrEqual),
        ("in", Comparison::In),
        ("has", Comparison::Has),
    ];

    /// The comparison of an operator of expressions, if it is one.
    pub fn of(operator: BinaryOperator) -> Option<Comparison> {
        Comparison::WRITTEN.map(|(_, comparison)| comparison).into_iter().find(|c| c.operator() == Some(operator))
    }

    fn operator(self) -> Option<BinaryOperator> {
        Some(match self {
            Comparison::Equal => BinaryOperator::Equal,
            Comparison::NotEqual => BinaryOperator::NotEqual,
            Comparison::Less => BinaryOperator::Less,
            Comparison::LessOrEqual => BinaryOperator::LessOrEqual,
            Comparison::Greater => BinaryOperator::Greater,
            Comparison::GreaterOrEqual => BinaryOperator::GreaterOrEqual,
            Comparison::In => BinaryOperator::In,
            Comparison::Has => return None,
        })
    }
}

impl Condition {
    /// The condition that an attribute exists.
    pub fn has(attribute: impl Into<String>) -> Condition {
        Condition { attribute: attribute.into(), comparison: Comparison::Has, value: Value::Null }
    }

    /// Whether an attribute with this value satisfies the condition.
    pub fn holds(&self, have: &Value) -> bool {
        match self.comparison.operator() {
            None => true,
            Some(operator) => compare(operator, have, &self.value).unwrap_or(false),
        }
    }
}

/// Error: the text is no condition.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is no condition on an attribute: {problem}; write {}", ConditionExpr::WRITTEN)]
pub struct InvalidCondition {
    /// The text.
    pub text: String,
    /// What is wrong, and where.
    pub problem: String,
}

impl FromStr for Condition {
    type Err = InvalidCondition;

    fn from_str(text: &str) -> Result<Condition, InvalidCondition> {
        let invalid = |problem: String| InvalidCondition { text: text.to_owned(), problem };
        let read = match ConditionExpr::presence(text) {
            Some(condition) => condition,
            None => {
                let expression = parse_expression(text, &mut NoNames);
                let expression =
                    expression.map_err(|e| invalid(format!("{} at character {}", e.message, e.offset + 1)))?;
                let problem = "it compares no attribute by its name";
                ConditionExpr::comparison(expression).ok_or_else(|| invalid(problem.to_owned()))?
            }
        };
        read.bind(&NothingKnown).map_err(|error| invalid(error.to_string()))
    }
}

impl ConditionExpr {
    /// How to write a condition, for messages.
    pub(crate) const WRITTEN: &str =
        "one attribute and what it must be like: `payload >= 2.5`, `tool in [gripper, welder]`, `has camera`";

    /// Parses `has camera`, if it is that.
    pub(crate) fn presence(text: &str) -> Option<ConditionExpr> {
        let is_name =
            |name: &&str| !name.is_empty() && name.chars().all(|c| c.is_alphanumeric() || c == '_' || c == '-');
        let attribute = text.trim().strip_prefix("has ").map(str::trim).filter(is_name)?.to_owned();
        Some(ConditionExpr { attribute, comparison: Comparison::Has, value: Expr::Literal(Value::Null) })
    }

    /// An expression like `payload >= 2.5` as a condition.
    pub(crate) fn comparison(expression: Expr) -> Option<ConditionExpr> {
        let Expr::Binary(operator, left, right) = expression else { return None };
        let Expr::Literal(Value::String(attribute)) = *left else { return None };
        Some(ConditionExpr { attribute, comparison: Comparison::of(operator)?, value: *right })
    }

    /// The condition with its value evaluated.
    ///
    /// # Errors
    /// As [`Expr::evaluate`]; also if the operand of `in` is no list.
    pub fn bind(&self, scope: &dyn Scope) -> Result<Condition, EvaluateError> {
        let value = self.value.evaluate(scope)?;
        if self.comparison == Comparison::In && !matches!(value, Value::List(_)) {
            return Err(self.value.wrong(format!("`{} in` takes a list", self.attribute)));
        }
        Ok(Condition { attribute: self.attribute.clone(), comparison: self.comparison, value })
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let written = Comparison::WRITTEN.iter().find(|(_, comparison)| comparison == self);
        f.write_str(written.map_or("", |(word, _)| word))
    }
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.attribute, self.comparison, &self.value)
    }
}

impl fmt::Display for ConditionExpr {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        written(f, &self.attribute, self.comparison, &self.value)
    }
}

fn written(
    f: &mut fmt::Formatter<'_>,
    attribute: &str,
    comparison: Comparison,
    value: &dyn fmt::Display,
) -> fmt::Result {
    match comparison {
        Comparison::Has => write!(f, "has {attribute}"),
        _ => write!(f, "{attribute} {comparison} {value}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conditions_are_read_as_they_are_written_and_what_is_none_is_refused_with_its_place() {
        for text in
            ["payload >= 2.5", "tool in [gripper, welder]", "has camera", "host = compute", "a != true", "n < 3"]
        {
            assert_eq!(text.parse::<Condition>().map(|condition| condition.to_string()), Ok(text.to_owned()));
        }
        let why = |text: &str| text.parse::<Condition>().err().map(|error| error.to_string()).unwrap_or_default();
        assert!(why("payload >=").contains("`payload >=` is no condition on an attribute: "), "{}", why("payload >="));
        assert!(
            why("payload").contains("it compares no attribute by its name; write one attribute"),
            "{}",
            why("payload")
        );
        assert!(why("2 < payload").contains("it compares no attribute by its name"), "{}", why("2 < payload"));
        assert!(why("tool in 3").contains("takes a list"), "{}", why("tool in 3"));
        assert!(why("a ~ 3").contains("at character"), "{}", why("a ~ 3"));
        assert!(why("a = $x").contains("is no constant"), "{}", why("a = $x"));
    }

    #[test]
    fn an_attribute_is_compared_as_in_expressions_and_what_cannot_be_compared_meets_nothing() {
        let holds = |have: Value, comparison, value: Value| {
            Condition { attribute: "a".to_owned(), comparison, value }.holds(&have)
        };
        use Comparison::{Equal, Greater, GreaterOrEqual, Has, In, Less, LessOrEqual, NotEqual};
        assert!(holds(Value::Int(2), Equal, Value::Float(2.0)) && !holds(Value::Int(2), Equal, Value::Int(3)));
        assert!(holds(Value::Int(2), NotEqual, Value::Int(3)) && !holds(Value::Int(2), NotEqual, Value::Float(2.0)));
        assert!(holds(Value::Int(2), Less, Value::Float(2.5)) && !holds(Value::Int(2), Less, Value::Int(2)));
        assert!(holds(Value::Int(2), LessOrEqual, Value::Int(2)) && !holds(Value::Int(3), LessOrEqual, Value::Int(2)));
        assert!(holds(Value::Float(2.5), Greater, Value::Int(2)) && !holds(Value::Int(2), Greater, Value::Int(2)));
        assert!(holds(Value::Int(2), GreaterOrEqual, Value::Int(2)));
        let tools = Value::List(vec![Value::String("gripper".to_owned()), Value::Int(7)].into());
        assert!(holds(Value::Float(7.0), In, tools.clone()) && !holds(Value::Int(8), In, tools));
        assert!(holds(Value::Null, Has, Value::Null));
        assert!(!holds(Value::Bool(true), Less, Value::Int(2)) && !holds(Value::Int(2), Less, Value::Bool(true)));
        assert!(!holds(Value::Int(2), In, Value::Int(2)));
    }
}
