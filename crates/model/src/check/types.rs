//! The types of expressions, as far as they are known before the run; `any` fits every type and is checked at run time.

use super::{Subject, Variables, constants, expressions, functions, named};
use crate::diagnostic::Findings;
use crate::expression::{BinaryOperator, Comprehension, EffectExpr, Expr, Function, UnaryOperator};
use crate::program::{Program, State, StateKind, TaskOutput};
use crate::slot::Slot;
use crate::value::{Type, Value};
use std::collections::BTreeMap;

/// Limit of outputs of hierarchies that refer to outputs of hierarchies.
const MAX_INDIRECTION: usize = 32;

pub(super) fn check(subject: &Subject<'_>, findings: &mut Findings) {
    let program = subject.program;
    for state in &program.states {
        let types =
            Types { subject, state, variables: variables(subject, state), elements: Variables::new(), indirection: 0 };
        let quantified = quantified(state);
        for (slot, expr) in expressions(program, state) {
            // Quantified effects bind their own variables; these are checked at run time.
            let bound = expr.variables().iter().any(|name| quantified.contains(name));
            if bound && matches!(slot, Slot::Effect(_)) {
                continue;
            }
            let at = subject.place_of(state, slot);
            match types.collected(state, expr).map_or_else(|| types.of(expr), Ok) {
                Err(Wrong { rule, message, help }) => findings.error(rule, at, &state.path, message, help),
                Ok(found) => {
                    if let Some(wanted) = wanted(subject, state, slot)
                        && !fits(&wanted, &found, expr)
                    {
                        let message = format!("`{}` is {wanted}; `{}` is {found}", what(slot), named(program, expr));
                        let help = types.without_sign(&[expr]);
                        let help = if help.is_empty() { written(&wanted, program, expr) } else { help };
                        findings.error("type-mismatch", at, &state.path, message, help);
                    } else {
                        constants::check(subject, state, slot, expr, findings);
                    }
                }
            }
        }
    }
}

/// The boolean meant by a text that other languages use for one.
pub(crate) fn truth(text: &str) -> Option<&'static str> {
    match text.to_ascii_lowercase().as_str() {
        "true" | "yes" | "on" => Some("write `true`"),
        "false" | "no" | "off" => Some("write `false`"),
        _ => None,
    }
}

/// How to write a list as joints or as a pose, where one is expected.
pub(crate) fn called(wanted: &Type, items: &[String]) -> Option<String> {
    let function = match wanted {
        Type::Joints if !items.is_empty() => "joints",
        Type::Pose if matches!(items.len(), 3 | 6) => "pose",
        _ => return None,
    };
    Some(format!("write \"{function}({})\"", items.join(", ")))
}

/// How to write a value as one of the expected type; empty if unknown.
fn written(wanted: &Type, program: &Program, expr: &Expr) -> String {
    if let Expr::List(items) = expr {
        let items: Vec<String> = items.iter().map(|item| named(program, item)).collect();
        if let Some(call) = called(wanted, &items) {
            return call;
        }
    }
    match (wanted, expr) {
        (Type::Pose, Expr::List(_) | Expr::Map(_)) => {
            "write \"pose(x, y, z)\" or \"pose(x, y, z, roll, pitch, yaw)\", in metres and radians".to_owned()
        }
        (Type::Bool, Expr::Literal(Value::String(text))) => truth(text).unwrap_or_default().to_owned(),
        (Type::List(_), Expr::Literal(_)) => format!("write `[{}]`", named(program, expr)),
        _ => String::new(),
    }
}

pub(crate) fn of_value(value: &Value) -> Type {
    match value {
        Value::Null => Type::Any,
        Value::Bool(_) => Type::Bool,
        Value::Int(_) => Type::Int,
        Value::Float(_) => Type::Float,
        Value::String(_) => Type::String,
        Value::Pose(_) => Type::Pose,
        Value::Joints(_) => Type::Joints,
        Value::Trajectory(_) => Type::Trajectory,
        Value::Bytes(_) => Type::Bytes,
        Value::List(items) => Type::List(Box::new(common(items.iter().map(of_value)))),
        Value::Map(fields) => Type::Record(fields.iter().map(|(name, v)| (name.clone(), of_value(v))).collect()),
    }
}

/// The common type: that of all of them, or `any`.
fn common(types: impl Iterator<Item = Type>) -> Type {
    types
        .reduce(|a, b| {
            if a.accepts_type(&b) && a != Type::Any {
                a
            } else if b.accepts_type(&a) && b != Type::Any {
                b
            } else {
                Type::Any
            }
        })
        .unwrap_or(Type::Any)
}

/// A literal null is accepted: it stands for an omitted input.
fn fits(wanted: &Type, found: &Type, expr: &Expr) -> bool {
    wanted.accepts_type(found) || *expr == Expr::Literal(Value::Null)
}

fn what(slot: Slot<'_>) -> String {
    match slot {
        Slot::Input(name) | Slot::Output(name) => name.to_owned(),
        Slot::Requires(_) => "requires".to_owned(),
        Slot::Holds(_) => "while".to_owned(),
        Slot::Decide(_) => "decide".to_owned(),
        other => other.to_string(),
    }
}

fn wanted(subject: &Subject<'_>, state: &State, slot: Slot<'_>) -> Option<Type> {
    match (slot, &state.kind) {
        (Slot::Input(port), _) if state.is_pause() => match port {
            "for" => Some(Type::Bool),
            "seconds" | "until" => Some(Type::Float),
            "question" => Some(Type::String),
            _ => None,
        },
        (Slot::Input(port), StateKind::Action { provider, action, .. }) => {
            let signature = subject.catalogue.action(provider, action)?;
            signature.inputs.get(port).or_else(|| signature.optional.get(port)).cloned()
        }
        (Slot::Output(name), _) => {
            let own = if state.id == Program::ROOT { &subject.program.outputs } else { state.outputs() };
            own.iter().find(|output| output.name == name).map(|output| output.ty.clone())
        }
        (Slot::Requires(_) | Slot::Holds(_) | Slot::Decide(_) | Slot::Condition | Slot::While, _) => Some(Type::Bool),
        (Slot::Collection, _) => Some(Type::List(Box::new(Type::Any))),
        (Slot::Duration, _) => Some(Type::Float),
        _ => None,
    }
}

fn quantified(state: &State) -> Vec<&str> {
    fn collect<'a>(effect: &'a EffectExpr, names: &mut Vec<&'a str>) {
        if let EffectExpr::ForEach { variable, effects, .. } = effect {
            names.push(variable);
            effects.iter().for_each(|inner| collect(inner, names));
        }
    }
    let mut names = Vec::new();
    state.annotations.effects.values().flatten().for_each(|effect| collect(effect, &mut names));
    names
}

/// The types of the variables in scope in a state: parameters, and those of the loops and hierarchies around it.
fn variables(subject: &Subject<'_>, state: &State) -> Variables {
    let program = subject.program;
    let mut variables: Variables = program.parameters.iter().map(|p| (p.name.clone(), p.ty.clone())).collect();
    // Expressions at a state's end or between iterations also see the state's own variables.
    let mut around: Vec<&State> = subject.around(state.id).collect();
    around.reverse();
    for outer in around {
        // An assignment may give a scoped variable a value of another type.
        variables.extend(outer.variables.iter().map(|(name, _)| (name.clone(), Type::Any)));
        if let StateKind::While { index: Some(index), .. } = &outer.kind {
            variables.insert(index.clone(), Type::Int);
        }
        if let StateKind::ForEach { variable, index, collection, .. } = &outer.kind {
            let types = Types {
                subject,
                state: outer,
                variables: variables.clone(),
                elements: Variables::new(),
                indirection: 0,
            };
            let element = match types.of(collection) {
                Ok(Type::List(element)) => *element,
                _ => Type::Any,
            };
            variables.insert(variable.clone(), element);
            variables.extend(index.iter().map(|name| (name.clone(), Type::Int)));
        }
    }
    variables
}

struct Types<'a> {
    subject: &'a Subject<'a>,
    state: &'a State,
    variables: Variables,
    /// The elements of the surrounding comprehensions.
    elements: Variables,
    indirection: usize,
}

type Found = Result<Type, Wrong>;

/// Error: an expression has no type.
pub(super) struct Wrong {
    pub(super) rule: &'static str,
    pub(super) message: String,
    pub(super) help: String,
}

impl Types<'_> {
    fn of(&self, expr: &Expr) -> Found {
        let wrong = |message: String| {
            let message = format!("`{}`: {message}", named(self.subject.program, expr));
            let operands: Vec<&Expr> = match expr {
                Expr::Unary(_, a) | Expr::Field(a, _) => vec![a],
                Expr::Binary(_, a, b) | Expr::Index(a, b) => vec![a, b],
                Expr::Each { list, .. } => vec![list],
                Expr::Call(_, arguments) => arguments.iter().collect(),
                _ => Vec::new(),
            };
            Err(Wrong { rule: "type-mismatch", message, help: self.without_sign(&operands) })
        };
        Ok(match expr {
            Expr::Literal(value) => of_value(value),
            Expr::Variable(name) => self.variables.get(name).cloned().unwrap_or(Type::Any),
            Expr::Output(name) => self.port(self.state, name),
            Expr::Port { state, port } => self.port(self.subject.program.state(*state), port),
            Expr::Field(of, name) => match (self.of(of)?, name.as_str()) {
                (Type::Record(fields), _) => match fields.get(name) {
                    Some(ty) => ty.clone(),
                    None => {
                        let known = fields.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
                        return wrong(format!("there is no field `{name}`, only {known}"));
                    }
                },
                (Type::Map(element), _) => *element,
                (Type::Pose, "x" | "y" | "z") | (Type::Trajectory, "duration_s") => Type::Float,
                (Type::Any, _) => Type::Any,
                (other, _) => return wrong(format!("{other} has no field `{name}`")),
            },
            Expr::Index(of, index) => {
                let index = self.of(index)?;
                let wanted = |ty: Type| if ty.accepts_type(&index) { Ok(()) } else { Err(ty) };
                let (element, fits) = match self.of(of)? {
                    Type::List(element) => (*element, wanted(Type::Int)),
                    Type::Joints => (Type::Float, wanted(Type::Int)),
                    Type::Map(element) => (*element, wanted(Type::String)),
                    Type::Any | Type::Record(_) => (Type::Any, Ok(())),
                    other => return wrong(format!("{other} has no elements")),
                };
                match fits {
                    Ok(()) => element,
                    Err(ty) => return wrong(format!("expected {ty} as index, found {index}")),
                }
            }
            Expr::List(items) => {
                let types = items.iter().map(|item| self.of(item)).collect::<Result<Vec<_>, _>>()?;
                Type::List(Box::new(common(types.into_iter())))
            }
            Expr::Map(fields) => {
                let typed = fields.iter().map(|(name, value)| Ok((name.clone(), self.of(value)?)));
                Type::Record(typed.collect::<Result<BTreeMap<_, _>, Wrong>>()?)
            }
            Expr::Call(function, arguments) => {
                let types = arguments.iter().map(|a| self.of(a)).collect::<Result<Vec<_>, _>>()?;
                match call(*function, arguments, &types) {
                    Ok(ty) => ty,
                    Err(message) => return wrong(message),
                }
            }
            Expr::Fact(fact) | Expr::Exists(fact) => {
                for argument in fact.arguments.iter().flatten() {
                    let found = self.of(argument)?;
                    if !(Type::String.accepts_type(&found) || Type::Int.accepts_type(&found) || found == Type::Any) {
                        return Err(functions::no_fact(self.subject, fact, &found));
                    }
                }
                if matches!(expr, Expr::Exists(_)) { Type::Bool } else { Type::Any }
            }
            Expr::Query(conditions) => {
                conditions.iter().try_for_each(|condition| self.of(condition).map(drop))?;
                Type::Bool
            }
            Expr::Find(_, conditions) => {
                conditions.iter().try_for_each(|condition| self.of(condition).map(drop))?;
                Type::List(Box::new(Type::Any))
            }
            Expr::Unknown(_) => Type::Any,
            Expr::Element(name) => self.elements.get(name).cloned().unwrap_or(Type::Any),
            Expr::Each { what, element, list, body } => {
                let of = match self.of(list)? {
                    Type::List(of) => *of,
                    Type::Any => Type::Any,
                    other => return wrong(format!("expected a list, found {other}")),
                };
                let body = self.within(element, of.clone()).of(body)?;
                if what.asks() && !Type::Bool.accepts_type(&body) {
                    return wrong(format!("its condition is bool, found {body}"));
                }
                match what {
                    Comprehension::Map => Type::List(Box::new(body)),
                    Comprehension::Filter | Comprehension::SortBy => Type::List(Box::new(of)),
                    Comprehension::MinBy | Comprehension::MaxBy => of,
                    Comprehension::Any | Comprehension::All => Type::Bool,
                }
            }
            Expr::Unary(operator, operand) => {
                let found = self.of(operand)?;
                let wanted = match operator {
                    UnaryOperator::Not => Type::Bool,
                    UnaryOperator::Negate => Type::Float,
                };
                if !wanted.accepts_type(&found) {
                    return wrong(format!("expected {wanted}, found {found}"));
                }
                if wanted == Type::Bool { Type::Bool } else { found }
            }
            Expr::Binary(operator, a, b) => match binary(*operator, self.of(a)?, self.of(b)?) {
                Ok(ty) => ty,
                Err(message) => return wrong(message),
            },
        })
    }

    /// The correction if one of these expressions is a variable name without `$`, which makes it a text; else empty.
    fn without_sign(&self, exprs: &[&Expr]) -> String {
        let is_variable = |name: &str| self.variables.contains_key(name) || self.elements.contains_key(name);
        let name = exprs.iter().find_map(|expr| match expr {
            Expr::Literal(Value::String(text)) if is_variable(text) => Some(text),
            _ => None,
        });
        name.map_or_else(String::new, |name| format!("the variable `{name}` is written `${name}`"))
    }

    /// The same scope inside of a comprehension with this element.
    fn within(&self, element: &str, of: Type) -> Self {
        let mut elements = self.elements.clone();
        elements.insert(element.to_owned(), of);
        Types { variables: self.variables.clone(), elements, ..*self }
    }

    fn port(&self, state: &State, port: &str) -> Type {
        match &state.kind {
            StateKind::Action { outputs, .. } => outputs.get(port).cloned().unwrap_or(Type::Any),
            _ => {
                let output = state.outputs().iter().find(|output| output.name == port);
                output.map_or(Type::Any, |output| self.output(state, output))
            }
        }
    }

    /// The type of the list that a loop collects, if the expression is this list.
    fn collected(&self, state: &State, value: &Expr) -> Option<Type> {
        let Expr::Variable(list) = value else { return None };
        let pass = state.children().find(|child| self.subject.program.is_pass(*child))?;
        let pass = self.subject.program.state(pass);
        let (_, longer) = pass.assign.iter().find(|(name, _)| name == list)?;
        let Expr::Binary(BinaryOperator::Add, _, added) = longer else { return None };
        let (subject, indirection) = (self.subject, self.indirection + 1);
        let variables = variables(subject, pass);
        Types { subject, state: pass, variables, elements: Variables::new(), indirection }.of(added).ok()
    }

    /// The declared type of a hierarchy's output, else the type of its expression.
    fn output(&self, state: &State, output: &TaskOutput) -> Type {
        if output.ty != Type::Any || self.indirection >= MAX_INDIRECTION {
            return output.ty.clone();
        }
        if let Some(list) = self.collected(state, &output.value) {
            return list;
        }
        let (subject, variables, indirection) = (self.subject, self.variables.clone(), self.indirection + 1);
        Types { subject, state, variables, elements: Variables::new(), indirection }
            .of(&output.value)
            .unwrap_or(Type::Any)
    }
}

fn call(function: Function, arguments: &[Expr], types: &[Type]) -> Result<Type, String> {
    let expect = |i: usize, wanted: Type| match types.get(i) {
        Some(found) if !wanted.accepts_type(found) => Err(format!("argument {} is {wanted}, found {found}", i + 1)),
        _ => Ok(()),
    };
    let all = |wanted: Type| (0..types.len()).try_for_each(|i| expect(i, wanted.clone()));
    Ok(match function {
        Function::Len => {
            if !matches!(
                types,
                [Type::Any | Type::List(_) | Type::Map(_) | Type::Record(_) | Type::String | Type::Joints]
            ) {
                return Err(format!("expected `{}`", function.usage()));
            }
            Type::Int
        }
        Function::Range => {
            all(Type::Int)?;
            Type::List(Box::new(Type::Int))
        }
        Function::Min | Function::Max => match types {
            [Type::List(element)] => element.as_ref().clone(),
            _ => common(types.iter().cloned()),
        },
        Function::Abs => {
            expect(0, Type::Float)?;
            types[0].clone()
        }
        Function::Sqrt => {
            expect(0, Type::Float)?;
            Type::Float
        }
        Function::Floor => {
            expect(0, Type::Float)?;
            Type::Int
        }
        Function::Sum => {
            expect(0, Type::List(Box::new(Type::Float)))?;
            match &types[0] {
                Type::List(element) => element.as_ref().clone(),
                _ => Type::Any,
            }
        }
        Function::Distance | Function::Angle => {
            all(Type::Pose)?;
            Type::Float
        }
        Function::Sort | Function::Reverse | Function::Unique => {
            expect(0, Type::List(Box::new(Type::Any)))?;
            types[0].clone()
        }
        Function::StartsWith => {
            all(Type::String)?;
            Type::Bool
        }
        Function::If => {
            expect(0, Type::Bool)?;
            let null = |e: &Expr| *e == Expr::Literal(Value::Null);
            match (null(&arguments[1]), null(&arguments[2])) {
                (true, _) => types[2].clone(),
                (_, true) => types[1].clone(),
                _ => common(types[1..].iter().cloned()),
            }
        }
        Function::Either => {
            let fit = |(a, b): &(&Type, &Type)| a.accepts_type(b) || b.accepts_type(a);
            let pairs = types.iter().enumerate().flat_map(|(n, a)| types[n + 1..].iter().map(move |b| (a, b)));
            if let Some((a, b)) = pairs.into_iter().find(|pair| !fit(pair)) {
                return Err(format!("one way gives {a}, another {b}"));
            }
            common(types.iter().cloned())
        }
        Function::Pose => {
            all(Type::Float)?;
            Type::Pose
        }
        Function::Joints => {
            all(Type::Float)?;
            Type::Joints
        }
        Function::Compose | Function::Between | Function::Inverse => {
            all(Type::Pose)?;
            Type::Pose
        }
        Function::GraspPose => {
            let size = Type::List(Box::new(Type::Float));
            expect(0, Type::Record([("pose".to_owned(), Type::Pose), ("size".to_owned(), size)].into()))?;
            Type::List(Box::new(Type::Pose))
        }
        Function::PlacePose => {
            expect(0, Type::Pose)?;
            expect(1, Type::Pose)?;
            if types.len() > 2 {
                expect(2, Type::Int)?;
            }
            Type::List(Box::new(Type::Pose))
        }
        Function::Concat => {
            let text = |ty: &&Type| !matches!(ty, Type::String | Type::Int | Type::Any);
            if let Some(found) = types.iter().find(text) {
                return Err(format!("expected strings and ints, found {found}"));
            }
            Type::String
        }
        Function::Take => {
            expect(0, Type::List(Box::new(Type::Any)))?;
            expect(1, Type::Int)?;
            types[0].clone()
        }
        Function::Repeat => {
            expect(1, Type::Int)?;
            Type::List(Box::new(types[0].clone()))
        }
    })
}

fn binary(operator: BinaryOperator, a: Type, b: Type) -> Result<Type, String> {
    use BinaryOperator as Op;
    let both = |wanted: Type| match [&a, &b].into_iter().find(|found| !wanted.accepts_type(found)) {
        Some(found) => Err(format!("expected {wanted}, found {found}")),
        None => Ok(()),
    };
    let numeric = || {
        both(Type::Float)?;
        Ok(match (&a, &b) {
            (Type::Int, Type::Int) => Type::Int,
            (Type::Any, _) | (_, Type::Any) => Type::Any,
            _ => Type::Float,
        })
    };
    match operator {
        Op::Or | Op::And => both(Type::Bool).map(|()| Type::Bool),
        Op::Equal | Op::NotEqual => Ok(Type::Bool),
        Op::Less | Op::LessOrEqual | Op::Greater | Op::GreaterOrEqual => match (&a, &b) {
            (Type::String, Type::String | Type::Any) | (Type::Any, Type::String) => Ok(Type::Bool),
            _ => both(Type::Float).map(|()| Type::Bool),
        },
        Op::In => match b {
            Type::List(_) | Type::Map(_) | Type::Record(_) | Type::Any => Ok(Type::Bool),
            other => Err(format!("expected a list after `in`, found {other}")),
        },
        Op::Add => match (&a, &b) {
            (Type::List(x), Type::List(y)) => {
                Ok(Type::List(Box::new(common([(**x).clone(), (**y).clone()].into_iter()))))
            }
            (Type::List(_), Type::Any) | (Type::Any, Type::List(_)) => Ok(Type::List(Box::new(Type::Any))),
            _ => numeric(),
        },
        Op::Subtract | Op::Multiply => numeric(),
        Op::Divide => both(Type::Float).map(|()| Type::Float),
    }
}
