//! Parser: text → expression, by recursive descent.
//!
//! ```text
//! or         = and { "or" and }
//! and        = not { "and" not }
//! not        = "not" not | comparison
//! comparison = sum [ ("=" | "==" | "!=" | "<" | "<=" | ">" | ">=" | "in") sum ]
//! sum        = product { ("+" | "-") product }
//! product    = unary { ("*" | "/") unary }
//! unary      = "-" unary | postfix
//! postfix    = primary { "." name | "[" or "]" }
//! primary    = number | text | "true" | "false" | "null" | "$"name | "(" or ")" | "[" list "]" | "{" name ":" or … "}"
//!            | comprehension "(" "$"name "in" or "," or ")"
//!            | "exists" ( fact | "(" query ")" ) | "?"name | function "(" list ")" | fact | state "." port | individual
//! fact       = predicate "(" [ ("?" | or) { "," ("?" | or) } ] ")"
//! query      = or { "," or }
//! effect     = ["set"] fact ["=" or] | ("delete" | "not") fact | ("increase" | "decrease") fact "by" or
//! ```
//!
//! `?name` is allowed only in queries. [`Names`] resolves names. The length of the text, its nesting and the height of the tree are bounded, so that
//! neither parsing nor evaluating can exhaust the stack.

use super::display::KEYWORDS;
use super::query::{PlanError, plan};
use super::token::{Token, tokens};
use super::{BinaryOperator, Comprehension, EffectExpr, Expr, FactExpr, Function, UnaryOperator};
use crate::value::Value;

/// Limit of an expression's text, in characters.
pub const MAX_TEXT: usize = 10_000;
/// Limit of nested brackets and prefixes.
const MAX_NESTING: usize = 48;
/// Limit of the tree's height (a chain of n operators has height n).
const MAX_HEIGHT: usize = 128;

/// The rule for syntax errors; unknown names have their own rules.
pub const INVALID_EXPRESSION: &str = "invalid-expression";

/// Error: a text is no expression.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct ParseError {
    /// The place, in characters from the start of the text.
    pub offset: usize,
    /// The violated rule of `check`.
    pub rule: &'static str,
    /// What is wrong.
    pub message: String,
    /// What to do; empty if the message already tells.
    pub help: String,
}

/// Error: a name has no meaning here.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NameError {
    /// The violated rule of `check`.
    pub rule: &'static str,
    /// What is wrong.
    pub message: String,
    /// What to do.
    pub help: String,
}

/// Resolves the names in an expression.
pub trait Names {
    /// `$name`
    ///
    /// # Errors
    /// No such variable is visible here.
    fn variable(&mut self, name: &str) -> Result<Expr, NameError>;
    /// A bare word: an output of the state itself if that is allowed here, else `None`, and the word is an individual.
    fn word(&mut self, word: &str) -> Option<Expr>;
    /// `state.port`
    ///
    /// # Errors
    /// No such port can be used here.
    fn port(&mut self, state: &str, port: &str) -> Result<Expr, NameError>;

    /// Whether `name(…)` is a function defined in the file.
    fn has_function(&self, name: &str) -> bool {
        let _ = name;
        false
    }

    /// Replaces a call of a function of the file.
    ///
    /// # Errors
    /// The number of arguments is wrong, or the result is too large.
    fn call(&mut self, name: &str, arguments: Vec<Expr>) -> Result<Expr, NameError> {
        let (message, _) = (format!("there is no function `{name}`"), arguments);
        Err(NameError { rule: "unknown-function", message, help: String::new() })
    }
}

impl ParseError {
    pub(crate) fn syntax(offset: usize, message: impl Into<String>) -> ParseError {
        ParseError { offset, rule: INVALID_EXPRESSION, message: message.into(), help: String::new() }
    }

    pub(crate) fn with_help(self, help: impl Into<String>) -> ParseError {
        ParseError { help: help.into(), ..self }
    }

    fn name(offset: usize, error: NameError) -> ParseError {
        ParseError { offset, rule: error.rule, message: error.message, help: error.help }
    }
}

/// Parses an expression.
///
/// # Errors
/// [`ParseError`] at the first error.
pub fn parse_expression(text: &str, names: &mut dyn Names) -> Result<Expr, ParseError> {
    parse(text, names, |parser| Ok(parser.or()?.expr))
}

/// Parses `predicate(a, ?)`.
///
/// # Errors
/// As [`parse_expression`].
pub fn parse_fact(text: &str, names: &mut dyn Names) -> Result<FactExpr, ParseError> {
    parse(text, names, |parser| Ok(parser.fact()?.0))
}

/// Parses the conditions of a query, `at(?box) = ?pose, weight(?box) < 2`.
///
/// # Errors
/// As [`parse_expression`]; also if the query cannot be planned ([`super::query`]).
pub fn parse_query(text: &str, names: &mut dyn Names) -> Result<Vec<Expr>, ParseError> {
    parse(text, names, |parser| Ok(parser.query(None)?.0))
}

/// Parses an effect.
///
/// # Errors
/// As [`parse_expression`].
pub fn parse_effect(text: &str, names: &mut dyn Names) -> Result<EffectExpr, ParseError> {
    parse(text, names, |parser| parser.effect())
}

fn parse<T>(
    text: &str,
    names: &mut dyn Names,
    what: impl FnOnce(&mut Parser<'_>) -> Result<T, ParseError>,
) -> Result<T, ParseError> {
    if text.chars().nth(MAX_TEXT).is_some() {
        return Err(ParseError::syntax(0, format!("an expression has at most {MAX_TEXT} characters")));
    }
    let mut parser = Parser { tokens: tokens(text)?, next: 0, nesting: 0, queries: 0, elements: Vec::new(), names };
    let result = what(&mut parser)?;
    match parser.peek() {
        Token::End => Ok(result),
        other => {
            let error = parser.unexpected(&format!("expected an operator or the end, found {}", other.described()));
            // `if a then b else c` stops behind the word `if`.
            let behind = parser.next.checked_sub(1).and_then(|before| parser.tokens.get(before));
            let help = behind.map_or_else(String::new, |(_, before)| meant(before));
            Err(error.with_help(match (behind, other) {
                (Some((_, Token::Word(_))), _) if !help.is_empty() => help,
                (Some((_, Token::Int(_) | Token::Float(_))), Token::Word(_)) if meant(other).is_empty() => {
                    "write the number alone: units are seconds, metres and radians".to_owned()
                }
                _ => meant(other),
            }))
        }
    }
}

/// Advice for an unexpected token; empty if there is none.
fn meant(token: &Token) -> String {
    match token {
        Token::Symbol("?") => "write `if(condition, a, b)`".to_owned(),
        Token::Symbol("==") => "write `=`".to_owned(),
        Token::Word(word) => match word.to_ascii_lowercase().as_str() {
            lower @ ("and" | "or" | "not" | "in") => format!("write `{lower}`, in small letters"),
            "is" => "write `=`".to_owned(),
            "if" | "then" | "else" => "write `if(condition, a, b)`".to_owned(),
            "for" => format!("write `{}` or `{}`", Comprehension::Map.usage(), Comprehension::Filter.usage()),
            _ => String::new(),
        },
        _ => String::new(),
    }
}

/// An expression and its height.
struct Tree {
    expr: Expr,
    height: usize,
}

struct Parser<'a> {
    tokens: Vec<(usize, Token)>,
    next: usize,
    nesting: usize,
    /// Number of open queries.
    queries: usize,
    /// The element names of the open comprehensions.
    elements: Vec<String>,
    names: &'a mut dyn Names,
}

type Parsed = Result<Tree, ParseError>;

impl Parser<'_> {
    fn peek(&self) -> &Token {
        self.tokens.get(self.next).map_or(&Token::End, |(_, token)| token)
    }

    fn peek_after(&self) -> &Token {
        self.tokens.get(self.next + 1).map_or(&Token::End, |(_, token)| token)
    }

    fn offset(&self) -> usize {
        self.tokens.get(self.next).or(self.tokens.last()).map_or(0, |(offset, _)| *offset)
    }

    fn advance(&mut self) -> Token {
        let token = self.peek().clone();
        self.next += 1;
        token
    }

    fn takes(&mut self, symbol: &str) -> bool {
        let found = matches!(self.peek(), Token::Symbol(s) if *s == symbol);
        self.next += usize::from(found);
        found
    }

    fn takes_word(&mut self, word: &str) -> bool {
        let found = matches!(self.peek(), Token::Word(w) if w == word);
        self.next += usize::from(found);
        found
    }

    fn expects(&mut self, symbol: &str) -> Result<(), ParseError> {
        if self.takes(symbol) {
            return Ok(());
        }
        let error = self.unexpected(&format!("expected `{symbol}`, found {}", self.peek().described()));
        Err(error.with_help(meant(self.peek())))
    }

    fn unexpected(&self, message: &str) -> ParseError {
        ParseError::syntax(self.offset(), message)
    }

    fn node(&self, expr: Expr, below: usize) -> Parsed {
        if below >= MAX_HEIGHT {
            return Err(self.unexpected("the expression is too large; split it"));
        }
        Ok(Tree { expr, height: below + 1 })
    }

    fn nested<T>(&mut self, what: impl FnOnce(&mut Self) -> Result<T, ParseError>) -> Result<T, ParseError> {
        if self.nesting >= MAX_NESTING {
            return Err(self.unexpected("brackets and prefixes nest too deep here"));
        }
        self.nesting += 1;
        let result = what(self);
        self.nesting -= 1;
        result
    }

    fn binary(&mut self, operator: BinaryOperator, a: Tree, b: Tree) -> Parsed {
        let below = a.height.max(b.height);
        self.node(Expr::Binary(operator, Box::new(a.expr), Box::new(b.expr)), below)
    }

    fn or(&mut self) -> Parsed {
        let mut tree = self.and()?;
        while self.takes_word("or") {
            let right = self.and()?;
            tree = self.binary(BinaryOperator::Or, tree, right)?;
        }
        Ok(tree)
    }

    fn and(&mut self) -> Parsed {
        let mut tree = self.not()?;
        while self.takes_word("and") {
            let right = self.not()?;
            tree = self.binary(BinaryOperator::And, tree, right)?;
        }
        Ok(tree)
    }

    fn not(&mut self) -> Parsed {
        if self.takes_word("not") {
            let operand = self.nested(Parser::not)?;
            return self.node(Expr::Unary(UnaryOperator::Not, Box::new(operand.expr)), operand.height);
        }
        let left = self.sum()?;
        let Some(operator) = self.comparison() else { return Ok(left) };
        let right = self.sum()?;
        let tree = self.binary(operator, left, right)?;
        let at = self.offset();
        if self.comparison().is_some() {
            return Err(ParseError::syntax(at, "comparisons do not chain; join two with `and`"));
        }
        Ok(tree)
    }

    fn comparison(&mut self) -> Option<BinaryOperator> {
        let operator = match self.peek() {
            Token::Symbol("=" | "==") => BinaryOperator::Equal,
            Token::Symbol("!=") => BinaryOperator::NotEqual,
            Token::Symbol("<") => BinaryOperator::Less,
            Token::Symbol("<=") => BinaryOperator::LessOrEqual,
            Token::Symbol(">") => BinaryOperator::Greater,
            Token::Symbol(">=") => BinaryOperator::GreaterOrEqual,
            Token::Word(word) if word == "in" => BinaryOperator::In,
            _ => return None,
        };
        self.next += 1;
        Some(operator)
    }

    fn sum(&mut self) -> Parsed {
        let mut tree = self.product()?;
        loop {
            let operator = match self.peek() {
                Token::Symbol("+") => BinaryOperator::Add,
                Token::Symbol("-") => BinaryOperator::Subtract,
                _ => return Ok(tree),
            };
            self.next += 1;
            let right = self.product()?;
            tree = self.binary(operator, tree, right)?;
        }
    }

    fn product(&mut self) -> Parsed {
        let mut tree = self.unary()?;
        loop {
            let operator = match self.peek() {
                Token::Symbol("*") => BinaryOperator::Multiply,
                Token::Symbol("/") => BinaryOperator::Divide,
                _ => return Ok(tree),
            };
            self.next += 1;
            let right = self.unary()?;
            tree = self.binary(operator, tree, right)?;
        }
    }

    fn unary(&mut self) -> Parsed {
        if !self.takes("-") {
            return self.postfix();
        }
        let operand = self.nested(Parser::unary)?;
        match operand.expr {
            Expr::Literal(Value::Int(i)) => self.node(Expr::Literal(Value::Int(-i)), 0),
            Expr::Literal(Value::Float(x)) => self.node(Expr::Literal(Value::Float(-x)), 0),
            expr => self.node(Expr::Unary(UnaryOperator::Negate, Box::new(expr)), operand.height),
        }
    }

    fn postfix(&mut self) -> Parsed {
        let mut tree = self.primary()?;
        loop {
            if self.takes(".") {
                let name = self.name("a field's name after `.`")?;
                tree = self.node(Expr::Field(Box::new(tree.expr), name), tree.height)?;
            } else if self.takes("[") {
                let index = self.nested(Parser::or)?;
                self.expects("]")?;
                let below = tree.height.max(index.height);
                tree = self.node(Expr::Index(Box::new(tree.expr), Box::new(index.expr)), below)?;
            } else {
                return Ok(tree);
            }
        }
    }

    fn name(&mut self, what: &str) -> Result<String, ParseError> {
        match self.peek() {
            Token::Word(word) => {
                let word = word.clone();
                self.next += 1;
                Ok(word)
            }
            other => Err(self.unexpected(&format!("expected {what}, found {}", other.described()))),
        }
    }

    fn primary(&mut self) -> Parsed {
        let at = self.offset();
        match self.peek().clone() {
            Token::Word(word) => self.word(at, &word),
            Token::Int(i) => self.literal(Value::Int(i)),
            Token::Float(x) => self.literal(Value::Float(x)),
            Token::Text(text) => self.literal(Value::String(text)),
            Token::Variable(name) => {
                self.next += 1;
                if self.elements.contains(&name) {
                    return self.node(Expr::Element(name), 0);
                }
                let expr = self.names.variable(&name).map_err(|e| ParseError::name(at, e))?;
                self.node(expr, 0)
            }
            Token::Symbol("(") => {
                self.next += 1;
                let inner = self.nested(Parser::or)?;
                self.expects(")")?;
                Ok(inner)
            }
            Token::Symbol("[") => {
                self.next += 1;
                let (items, below) = self.list("]")?;
                self.node(Expr::List(items), below)
            }
            Token::Symbol("{") => self.map(),
            Token::Symbol("?") if matches!(self.peek_after(), Token::Word(_)) => {
                let unknown = self.unknown()?;
                self.node(unknown, 0)
            }
            Token::Symbol("?") => Err(self.unexpected("`?` stands only for an argument of a fact")),
            other => Err(self.unexpected(&format!("expected a value, found {}", other.described()))),
        }
    }

    fn literal(&mut self, value: Value) -> Parsed {
        self.next += 1;
        self.node(Expr::Literal(value), 0)
    }

    fn word(&mut self, at: usize, word: &str) -> Parsed {
        match word {
            "true" => return self.literal(Value::Bool(true)),
            "false" => return self.literal(Value::Bool(false)),
            "null" => return self.literal(Value::Null),
            "exists" => {
                self.next += 1;
                if self.takes("(") {
                    let (conditions, below) = self.nested(|parser| parser.query(Some(")")))?;
                    return self.node(Expr::Query(conditions), below);
                }
                let (fact, below) = self.fact()?;
                return self.node(Expr::Exists(fact), below);
            }
            "find" if self.finds() && self.queries == 0 => return self.find(at),
            "find" if self.finds() => {
                let message = "a `find` stands in no other query; let a variable have what it finds, and say `?name in $variable` or `len($variable)` here";
                return Err(ParseError::syntax(at, message));
            }
            _ if KEYWORDS.contains(&word) => {
                return Err(self.unexpected(&format!("expected a value, found the keyword `{word}`")));
            }
            _ => {}
        }
        if matches!(self.peek_after(), Token::Symbol("(")) {
            if let Some(what) = Comprehension::named(word) {
                return self.comprehension(at, what);
            }
            if self.names.has_function(word) {
                self.next += 2;
                let (arguments, _) = self.list(")")?;
                let expr = self.names.call(word, arguments).map_err(|error| ParseError::name(at, error))?;
                let below = height(&expr) - 1;
                return self.node(expr, below);
            }
            let Some(function) = Function::named(word) else {
                let (fact, below) = self.fact()?;
                return self.node(Expr::Fact(fact), below);
            };
            self.next += 2;
            let (arguments, below) = self.list(")")?;
            if !function.takes(arguments.len()) {
                return Err(ParseError::syntax(at, format!("expected `{}`", function.usage())));
            }
            return self.node(Expr::Call(function, arguments), below);
        }
        self.next += 1;
        if let Some(expr) = self.names.word(word) {
            return self.node(expr, 0);
        }
        if self.takes(".") {
            let port = self.name("a port's name after `.`")?;
            let expr = self.names.port(word, &port).map_err(|e| ParseError::name(at, e))?;
            return self.node(expr, 0);
        }
        self.node(Expr::Literal(Value::String(word.to_owned())), 0)
    }

    fn comprehension(&mut self, at: usize, what: Comprehension) -> Parsed {
        let expected = || ParseError::syntax(at, format!("expected `{}`", what.usage()));
        self.next += 2;
        let name_at = self.offset();
        let Token::Variable(element) = self.advance() else { return Err(expected()) };
        if self.elements.contains(&element) || self.names.variable(&element).is_ok() {
            let message = format!("`${element}` has a meaning here already; give the element another name");
            return Err(ParseError::syntax(name_at, message));
        }
        if !self.takes_word("in") {
            return Err(expected());
        }
        let list = self.nested(Parser::or)?;
        if !self.takes(",") {
            return Err(expected());
        }
        self.elements.push(element);
        let body = self.nested(Parser::or);
        let element = self.elements.pop().unwrap_or_default();
        let body = body?;
        self.expects(")")?;
        let below = list.height.max(body.height);
        self.node(Expr::Each { what, element, list: Box::new(list.expr), body: Box::new(body.expr) }, below)
    }

    /// Expressions up to a closing bracket; the opening one has been read.
    fn list(&mut self, close: &str) -> Result<(Vec<Expr>, usize), ParseError> {
        let (mut items, mut below) = (Vec::new(), 0);
        while !self.takes(close) {
            if !items.is_empty() {
                self.expects(",")?;
            }
            let item = self.nested(Parser::or)?;
            below = below.max(item.height);
            items.push(item.expr);
        }
        Ok((items, below))
    }

    /// Conditions up to a closing bracket, or to the end of the text.
    fn query(&mut self, close: Option<&str>) -> Result<(Vec<Expr>, usize), ParseError> {
        let at = self.offset();
        self.queries += 1;
        let (mut conditions, mut below) = (Vec::new(), 0);
        loop {
            let condition = self.nested(Parser::or)?;
            below = below.max(condition.height);
            conditions.push(condition.expr);
            if !self.takes(",") {
                break;
            }
        }
        if let Some(close) = close {
            self.expects(close)?;
        }
        self.queries -= 1;
        // Variables that the outer query binds are known in an inner one.
        let inner = self.queries > 0;
        match plan(&conditions, &|_| false) {
            Err(PlanError::Unbound { .. }) if inner => {}
            Err(error) => return Err(ParseError::syntax(at, error.to_string())),
            Ok(_) => {}
        }
        Ok((conditions, below))
    }

    /// Whether `find(?name …` begins here; no fact can have this form.
    fn finds(&self) -> bool {
        let begins = [Some(&Token::Symbol("(")), Some(&Token::Symbol("?"))];
        let next = |ahead: usize| self.tokens.get(self.next + ahead).map(|(_, token)| token);
        [next(1), next(2)] == begins && matches!(next(3), Some(Token::Word(_)))
    }

    /// `find(?name, …, condition, …)`
    fn find(&mut self, at: usize) -> Parsed {
        self.next += 2;
        let mut wanted = Vec::new();
        // A variable followed by a comma is a wanted one. The conditions come after them.
        while let [Some(Token::Symbol("?")), Some(Token::Word(name)), Some(Token::Symbol(","))] =
            [0, 1, 2].map(|ahead| self.tokens.get(self.next + ahead).map(|(_, token)| token))
        {
            let name = name.clone();
            if wanted.contains(&name) {
                return Err(ParseError::syntax(at, format!("`?{name}` is wanted twice")));
            }
            wanted.push(name);
            self.next += 3;
        }
        let (conditions, below) = self.nested(|parser| parser.query(Some(")")))?;
        let plan = plan(&conditions, &|_| false).map_err(|error| ParseError::syntax(at, error.to_string()))?;
        if let Some(name) = wanted.iter().find(|name| !plan.variables().contains(name)) {
            let message = format!("no condition of this `find` says anything of `?{name}`");
            return Err(ParseError::syntax(at, message));
        }
        if wanted.is_empty() {
            let message =
                "nothing is wanted: write `find(?box, at(?box) = ?pose)`, first what is wanted and then the conditions";
            return Err(ParseError::syntax(at, message));
        }
        self.node(Expr::Find(wanted, conditions), below)
    }

    fn unknown(&mut self) -> Result<Expr, ParseError> {
        if self.queries == 0 {
            let message = "`?name` is a variable of a query, and stands only within `exists (…)` and `find(…)`";
            return Err(self.unexpected(message));
        }
        self.expects("?")?;
        Ok(Expr::Unknown(self.name("a variable's name after `?`")?))
    }

    fn map(&mut self) -> Parsed {
        self.expects("{")?;
        let (mut fields, mut below) = (Vec::<(String, Expr)>::new(), 0);
        while !self.takes("}") {
            if !fields.is_empty() {
                self.expects(",")?;
            }
            let at = self.offset();
            let name = match self.advance() {
                Token::Word(name) | Token::Text(name) => name,
                other => {
                    return Err(ParseError::syntax(
                        at,
                        format!("expected a field's name, found {}", other.described()),
                    ));
                }
            };
            if fields.iter().any(|(other, _)| *other == name) {
                return Err(ParseError::syntax(at, format!("the field `{name}` stands twice")));
            }
            self.expects(":")?;
            let value = self.nested(Parser::or)?;
            below = below.max(value.height);
            fields.push((name, value.expr));
        }
        self.node(Expr::Map(fields), below)
    }

    fn fact(&mut self) -> Result<(FactExpr, usize), ParseError> {
        let at = self.offset();
        let predicate = self.name("a fact `predicate(argument, …)`")?;
        let built_in = Function::named(&predicate).is_some() || Comprehension::named(&predicate).is_some();
        if built_in || KEYWORDS.contains(&predicate.as_str()) {
            let message = format!("`{predicate}` is built in and cannot be a predicate");
            return Err(ParseError::syntax(at, message));
        }
        if self.names.has_function(&predicate) {
            let message = format!("`{predicate}` is a function of this file, and here a fact is wanted");
            return Err(ParseError::syntax(at, message).with_help("give the function or the fact another name"));
        }
        self.expects("(").map_err(|error| {
            let help = match predicate.as_str() {
                "none" | "nothing" | "empty" => "write `[]` for no fact".to_owned(),
                _ => format!("a fact has its arguments in parentheses: `{predicate}(…)`"),
            };
            error.with_help(help)
        })?;
        let (mut arguments, mut below) = (Vec::new(), 0);
        while !self.takes(")") {
            if !arguments.is_empty() {
                self.expects(",")?;
            }
            let named = matches!(self.peek_after(), Token::Word(_));
            if !named && self.takes("?") {
                arguments.push(None);
            } else {
                let argument = self.nested(Parser::or)?;
                below = below.max(argument.height);
                arguments.push(Some(argument.expr));
            }
        }
        Ok((FactExpr { predicate, arguments }, below))
    }

    fn effect(&mut self) -> Result<EffectExpr, ParseError> {
        let verb = match (self.peek(), self.peek_after()) {
            (Token::Word(verb), Token::Word(_)) => verb.clone(),
            _ => String::new(),
        };
        self.next += usize::from(!verb.is_empty());
        let at = self.offset();
        let effect = match verb.as_str() {
            "" | "set" => {
                let (fact, _) = self.fact()?;
                let value = if self.takes("=") { self.or()?.expr } else { Expr::Literal(Value::Bool(true)) };
                EffectExpr::Set(fact, value)
            }
            "delete" | "not" => return Ok(EffectExpr::Delete(self.fact()?.0)),
            "increase" | "decrease" => {
                let (fact, _) = self.fact()?;
                if !self.takes_word("by") {
                    return Err(self.unexpected(&format!("expected `by`, found {}", self.peek().described())));
                }
                let amount = self.or()?.expr;
                let by = match verb.as_str() {
                    "increase" => amount,
                    _ => Expr::Unary(UnaryOperator::Negate, Box::new(amount)),
                };
                EffectExpr::Increase(fact, by)
            }
            other => {
                let message = format!("`{other}` is no effect: expected set, delete, increase or decrease");
                return Err(ParseError::syntax(0, message));
            }
        };
        let (EffectExpr::Set(fact, _) | EffectExpr::Increase(fact, _)) = &effect else { return Ok(effect) };
        if fact.arguments.iter().any(Option::is_none) {
            return Err(ParseError::syntax(at, "a fact that is written needs all its arguments; `?` is not one"));
        }
        Ok(effect)
    }
}

fn height(expr: &Expr) -> usize {
    let mut below = 0;
    expr.parts(&mut |part| below = below.max(height(part)));
    below + 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::expression::scope::NothingKnown;
    use crate::id::StateId;
    use proptest::prelude::*;

    /// Names for tests: `$box`, the state `plan` with its port `end`, and the own output `width_m`.
    struct OneState;

    impl Names for OneState {
        fn variable(&mut self, name: &str) -> Result<Expr, NameError> {
            if name == "box" { Ok(Expr::Variable(name.to_owned())) } else { Err(unknown("unknown-variable", name)) }
        }

        fn word(&mut self, word: &str) -> Option<Expr> {
            (word == "width_m").then(|| Expr::Output(word.to_owned()))
        }

        fn port(&mut self, state: &str, port: &str) -> Result<Expr, NameError> {
            match (state, port) {
                ("plan", "end") => Ok(Expr::Port { state: StateId(7), port: port.to_owned() }),
                _ => Err(unknown("unknown-port", port)),
            }
        }
    }

    fn unknown(rule: &'static str, name: &str) -> NameError {
        NameError { rule, message: format!("there is no `{name}`"), help: String::new() }
    }

    fn printed<T: std::fmt::Display>(result: Result<T, ParseError>) -> String {
        match result {
            Ok(parsed) => parsed.to_string(),
            Err(error) => format!("{}: {} at {}", error.rule, error.message, error.offset),
        }
    }

    fn check(text: &str, expect: &str) {
        assert_eq!(printed(parse_expression(text, &mut OneState)), expect, "{text}");
    }

    #[test]
    fn what_is_found_is_named_before_the_conditions() {
        check("find(?x, on(?x, table))", "find(?x, on(?x, table))");
        check("len(find(?x,?w, weight(?x) = ?w and ?w > 1)) > 2", "len(find(?x, ?w, weight(?x) = ?w and ?w > 1)) > 2");
        check("find(?x, ?x, on(?x, table))", "invalid-expression: `?x` is wanted twice at 0");
        check(
            "find(?x, ?y, on(?x, table))",
            "invalid-expression: no condition of this `find` says anything of `?y` at 0",
        );
        check(
            "find(?x)",
            "invalid-expression: `?x` in `?x` gets no value: no fact of the query has it as an argument or says it at 5",
        );
        check(
            "find(on(?x, table))",
            "invalid-expression: `?name` is a variable of a query, and stands only within `exists (…)` and `find(…)` at 8",
        );
    }

    #[test]
    fn operators_bind_as_in_other_languages() {
        check("1 + 2 * 3", "1 + 2 * 3");
        check("(1 + 2) * 3", "(1 + 2) * 3");
        check("1 - (2 - 3) - 4", "1 - (2 - 3) - 4");
        check("not a = b and c or d", "not a = b and c or d");
        check("not (a and b)", "not (a and b)");
        check("a == b", "a = b");
        check("-1.5e3 - -2", "-1500.0 - -2");
        check("$box in [1, 'two', three]", "$box in [1, two, three]");
        let sum = parse_expression("10 - 4 - 3", &mut OneState).map(|e| e.evaluate(&NothingKnown));
        assert_eq!(sum, Ok(Ok(Value::Int(3))));
    }

    #[test]
    fn names_are_what_the_state_sees() {
        check("plan.end[0].x", "s7.end[0].x");
        check("$box.pose", "$box.pose");
        check("width_m * 2", "width_m * 2");
        check("at($box.id, ?)", "at($box.id, ?)");
        check("exists at(?) and hand_empty(gripper)", "exists at(?) and hand_empty(gripper)");
        check("{id: $box, pose: pose(0, 0, 1)}", "{id: $box, pose: pose(0, 0, 1)}");
    }

    #[test]
    fn an_error_says_where_and_what() {
        check("1 +", "invalid-expression: expected a value, found the end at 3");
        check("(1", "invalid-expression: expected `)`, found the end at 2");
        check("1 2", "invalid-expression: expected an operator or the end, found `2` at 2");
        check("a < b < c", "invalid-expression: comparisons do not chain; join two with `and` at 6");
        check("pose(1)", "invalid-expression: expected `pose(x, y, z) or pose(x, y, z, roll, pitch, yaw)` at 0");
        check("2 * plan.ende", "unknown-port: there is no `ende` at 4");
        check("$bax", "unknown-variable: there is no `bax` at 0");
        check("? = 1", "invalid-expression: `?` stands only for an argument of a fact at 0");
        check("'open", "invalid-expression: this text has no closing quote at 0");
        check("3rd", "invalid-expression: a name does not begin with a digit, and `3rd` is no number at 0");
        check("a § b", "invalid-expression: unexpected character `§` at 2");
        check("99999999999999999999", "invalid-expression: 99999999999999999999 is too large for an int at 0");
    }

    #[test]
    fn effects_read_as_sentences() {
        let effect = |text: &str| printed(parse_effect(text, &mut OneState));
        assert_eq!(effect("set at($box) = plan.end"), "set at($box) = s7.end");
        assert_eq!(effect("at($box) = 1 + 1"), "set at($box) = 1 + 1");
        assert_eq!(effect("hand_empty(gripper)"), "set hand_empty(gripper) = true");
        assert_eq!(effect("delete at(?)"), "delete at(?)");
        assert_eq!(effect("not hand_empty(gripper)"), "delete hand_empty(gripper)");
        assert_eq!(effect("increase load(base) by 1"), "increase load(base) by 1");
        assert_eq!(effect("decrease load(base) by 2 + 1"), "increase load(base) by -(2 + 1)");
        assert_eq!(
            effect("set at(?) = 1"),
            "invalid-expression: a fact that is written needs all its arguments; `?` is not one at 4"
        );
        assert_eq!(
            effect("remove at(x)"),
            "invalid-expression: `remove` is no effect: expected set, delete, increase or decrease at 0"
        );
        assert_eq!(effect("set pose(x)"), "invalid-expression: `pose` is built in and cannot be a predicate at 4");
    }

    #[test]
    fn size_is_bounded_before_the_stack_is() {
        for text in ["(".repeat(9_000), "-".repeat(9_000), "not ".repeat(2_000), "[".repeat(9_000), "a(".repeat(4_000)]
        {
            assert!(parse_expression(&text, &mut OneState).is_err());
        }
        assert!(parse_expression(&"1 + ".repeat(2_000), &mut OneState).is_err());
        assert!(parse_expression(&format!("x{}", "[0]".repeat(3_000)), &mut OneState).is_err());
        assert!(parse_expression(&"1".repeat(MAX_TEXT + 1), &mut OneState).is_err());
        let largest = vec!["1"; MAX_HEIGHT].join(" + ");
        let sum = parse_expression(&largest, &mut OneState).map(|e| e.evaluate(&NothingKnown));
        assert_eq!(sum, Ok(Ok(Value::Int(128))));
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "\\PC{0,60}") {
            let _ = parse_expression(&text, &mut OneState);
            let _ = parse_effect(&text, &mut OneState);
        }

        #[test]
        fn what_parses_prints_as_what_parses_to_the_same(
            text in "(1|2\\.5|\\$box|plan\\.end|width_m|not |-|\\(|\\)|\\[|\\]| and | or | = | < | \\+ | \\* |at\\(|len\\(|, |\\.x){1,12}"
        ) {
            if let Ok(expr) = parse_expression(&text, &mut OneState) {
                let printed = expr.to_string().replace("s7.", "plan.");
                prop_assert_eq!(parse_expression(&printed, &mut OneState), Ok(expr));
            }
        }
    }
}
