//! Expressions to text, for messages. States are shown by their ids (`s3.end`) where their names are not available.

use super::{BinaryOperator, EffectExpr, Expr, FactExpr, UnaryOperator};
use crate::value::Value;
use std::fmt::{self, Display, Formatter};

impl BinaryOperator {
    /// The operator as written.
    pub fn symbol(self) -> &'static str {
        match self {
            BinaryOperator::Or => "or",
            BinaryOperator::And => "and",
            BinaryOperator::Equal => "=",
            BinaryOperator::NotEqual => "!=",
            BinaryOperator::Less => "<",
            BinaryOperator::LessOrEqual => "<=",
            BinaryOperator::Greater => ">",
            BinaryOperator::GreaterOrEqual => ">=",
            BinaryOperator::In => "in",
            BinaryOperator::Add => "+",
            BinaryOperator::Subtract => "-",
            BinaryOperator::Multiply => "*",
            BinaryOperator::Divide => "/",
        }
    }

    /// Its precedence; larger binds tighter.
    pub(crate) fn precedence(self) -> u8 {
        match self {
            BinaryOperator::Or => 1,
            BinaryOperator::And => 2,
            BinaryOperator::Equal
            | BinaryOperator::NotEqual
            | BinaryOperator::Less
            | BinaryOperator::LessOrEqual
            | BinaryOperator::Greater
            | BinaryOperator::GreaterOrEqual
            | BinaryOperator::In => 4,
            BinaryOperator::Add | BinaryOperator::Subtract => 5,
            BinaryOperator::Multiply | BinaryOperator::Divide => 6,
        }
    }
}

impl Expr {
    fn precedence(&self) -> u8 {
        match self {
            Expr::Binary(operator, ..) => operator.precedence(),
            Expr::Unary(UnaryOperator::Not, _) => 3,
            Expr::Unary(UnaryOperator::Negate, _) => 7,
            _ => 8,
        }
    }

    fn within(&self, f: &mut Formatter<'_>, at_least: u8) -> fmt::Result {
        if self.precedence() < at_least { write!(f, "({self})") } else { write!(f, "{self}") }
    }
}

impl Display for Expr {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Expr::Literal(Value::String(text)) if is_word(text) => f.write_str(text),
            Expr::Literal(Value::String(text)) => write!(f, "{text:?}"),
            Expr::Literal(Value::Float(x)) => write!(f, "{x:?}"),
            Expr::Literal(value) => write!(f, "{value}"),
            Expr::Variable(name) => write!(f, "${name}"),
            Expr::Output(name) => f.write_str(name),
            Expr::Port { state, port } => write!(f, "{state}.{port}"),
            Expr::Field(of, name) => {
                of.within(f, 8)?;
                write!(f, ".{name}")
            }
            Expr::Index(of, index) => {
                of.within(f, 8)?;
                write!(f, "[{index}]")
            }
            Expr::List(items) => {
                f.write_str("[")?;
                separated(f, items)?;
                f.write_str("]")
            }
            Expr::Map(fields) => {
                f.write_str("{")?;
                for (i, (name, value)) in fields.iter().enumerate() {
                    write!(f, "{}{name}: {value}", if i == 0 { "" } else { ", " })?;
                }
                f.write_str("}")
            }
            Expr::Call(function, arguments) => {
                write!(f, "{}(", function.name())?;
                separated(f, arguments)?;
                f.write_str(")")
            }
            Expr::Each { what, element, list, body } => write!(f, "{}(${element} in {list}, {body})", what.name()),
            Expr::Element(name) => write!(f, "${name}"),
            Expr::Fact(fact) => write!(f, "{fact}"),
            Expr::Exists(fact) => write!(f, "exists {fact}"),
            Expr::Query(conditions) => {
                f.write_str("exists (")?;
                separated(f, conditions)?;
                f.write_str(")")
            }
            Expr::Find(wanted, conditions) => {
                f.write_str("find(")?;
                wanted.iter().try_for_each(|name| write!(f, "?{name}, "))?;
                separated(f, conditions)?;
                f.write_str(")")
            }
            Expr::Unknown(name) => match name.rsplit_once('#') {
                Some((fact, _)) => f.write_str(fact),
                None => write!(f, "?{name}"),
            },
            Expr::Unary(UnaryOperator::Not, operand) => {
                f.write_str("not ")?;
                operand.within(f, 3)
            }
            Expr::Unary(UnaryOperator::Negate, operand) => {
                f.write_str("-")?;
                operand.within(f, 8)
            }
            Expr::Binary(operator, a, b) => {
                let own = operator.precedence();
                // Comparisons do not chain; the other operators are left-associative.
                a.within(f, if own == 4 { 5 } else { own })?;
                write!(f, " {} ", operator.symbol())?;
                b.within(f, own + 1)
            }
        }
    }
}

impl Display for FactExpr {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{}(", self.predicate)?;
        for (i, argument) in self.arguments.iter().enumerate() {
            f.write_str(if i == 0 { "" } else { ", " })?;
            match argument {
                Some(argument) => write!(f, "{argument}")?,
                None => f.write_str("?")?,
            }
        }
        f.write_str(")")
    }
}

impl Display for EffectExpr {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            EffectExpr::Set(fact, value) => write!(f, "set {fact} = {value}"),
            EffectExpr::Delete(fact) => write!(f, "delete {fact}"),
            EffectExpr::Increase(fact, by) => write!(f, "increase {fact} by {by}"),
            EffectExpr::ForEach { variable, collection, effects } => {
                write!(f, "for {variable} in {collection}: ")?;
                separated(f, effects)
            }
        }
    }
}

fn separated<T: Display>(f: &mut Formatter<'_>, items: &[T]) -> fmt::Result {
    for (i, item) in items.iter().enumerate() {
        write!(f, "{}{item}", if i == 0 { "" } else { ", " })?;
    }
    Ok(())
}

/// Whether the text would be parsed as a bare word, that is, as an individual.
pub(crate) fn is_word(text: &str) -> bool {
    let mut characters = text.chars();
    characters.next().is_some_and(|c| c.is_ascii_alphabetic() || c == '_')
        && characters.all(|c| c.is_ascii_alphanumeric() || c == '_')
        && !KEYWORDS.contains(&text)
}

/// Words that are no names of individuals.
pub(crate) const KEYWORDS: [&str; 8] = ["or", "and", "not", "in", "exists", "true", "false", "null"];
