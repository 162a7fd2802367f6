//! A predicate that is measured within a tolerance, and ontologies.
//!
//! With a tolerance, a node may have seen the predicted value where HSM mode shows the measured one. So that both modes behave
//! alike, the oracle rounds what nodes see of this predicate to whole numbers: predicted values are whole, measured ones are a
//! whole number plus or minus at most [`OFF`], and no program adds two of them up or copies one into another predicate. Comparisons
//! use a number and a half, which is midway between two whole numbers. The tolerance is between `OFF` and `1 - OFF`, so a value
//! near another whole number always counts as different, and one near the same number never does.

use super::*;
use ratn_model::ontology::Ontology;
use ratn_model::ontology::turtle;
use ratn_model::program::Nature;
use ratn_model::tolerance::Deviation;
use std::sync::LazyLock;

/// The predicate.
pub(crate) const TOLERANT: u64 = 30;
/// Largest difference between measured values and whole numbers.
pub(crate) const OFF: f64 = 0.2;
const TOLERANCE: f64 = 0.3;

/// Declares the tolerance in the task, or in an ontology that also declares other facts.
pub(super) fn declare(program: &mut Program, dice: &mut Dice) {
    if dice.percent(20) {
        program.ontology = Some(ONTOLOGY.clone());
        program.tolerances = ONTOLOGY.tolerances(Default::default());
    } else {
        let own = Deviation { number: Some(TOLERANCE), ..Deviation::default() };
        program.tolerances.predicates.insert(format!("p{TOLERANT}"), own);
    }
}

static ONTOLOGY: LazyLock<Ontology> = LazyLock::new(|| {
    let mut text = "@prefix ratn: <urn:ratn:ontology#> . @prefix owl: <http://www.w3.org/2002/07/owl#> .
        @prefix xsd: <http://www.w3.org/2001/XMLSchema#> . @prefix : <urn:trials#> .\n"
        .to_owned();
    let mut declare = |name: u64, arguments: &str, value: &str, more: &str| {
        text +=
            &format!(":p{name} a ratn:Predicate{more} ; ratn:arguments ( {arguments} ) ; ratn:value \"{value}\" .\n");
    };
    // The last two are read and deleted when there is nothing else to do, and never written.
    for predicate in 0..PREDICATES + 2 {
        declare(predicate, "owl:Thing", if predicate == 1 { "float" } else { "any" }, "");
    }
    declare(facts::COUNTER, "", "float", "");
    declare(21, "owl:Thing owl:Thing", "any", " , owl:FunctionalProperty");
    declare(22, "owl:Thing xsd:integer", "any", "");
    declare(23, "owl:Thing owl:Thing owl:Thing", "any", "");
    declare(facts::RECORD, "owl:Thing", "{a: int, b: int}", "");
    declare(TOLERANT, "xsd:integer", "float", "");
    text = text.replace(
        &format!(":p{TOLERANT} a ratn:Predicate"),
        &format!(":p{TOLERANT} ratn:tolerance {TOLERANCE} ; a ratn:Predicate"),
    );
    match turtle::read(&text) {
        Ok(ontology) => ontology,
        Err(error) => unreachable!("the ontology of random programs: {error}"),
    }
});

impl Maker {
    /// Makes some nodes read, require and write the predicate.
    pub(super) fn tolerated(&mut self, annotations: &mut Annotations, room: &Room) {
        if !room.tolerant || room.is_preemptive {
            return;
        }
        let key = || FactExpr { predicate: format!("p{TOLERANT}"), arguments: vec![None] };
        let some = |maker: &mut Maker, wildcards: u64| {
            let mut fact = key();
            if !maker.dice.percent(wildcards) {
                fact.arguments[0] = Some(Expr::Literal(Value::Int(maker.dice.below(2) as i64)));
            }
            fact
        };
        if self.dice.percent(20) {
            let fact = some(self, 30);
            match (&mut annotations.nature, &mut annotations.reads) {
                (Nature::Senses(facts), _) => facts.push(fact),
                (_, Some(reads)) => reads.push(fact),
                (_, None) => {}
            }
        }
        if self.dice.percent(8) {
            let required = self.tolerated_comparison();
            annotations.requires.push(required);
        }
        if annotations.nature != Nature::Computes && self.dice.percent(25) {
            let effect = match self.dice.below(8) {
                0 => EffectExpr::Delete(some(self, 50)),
                1 => {
                    let by = Expr::Literal(Value::Int(if self.dice.percent(50) { 1 } else { -1 }));
                    EffectExpr::Increase(some(self, 0), by)
                }
                2 | 3 => EffectExpr::Set(some(self, 0), Expr::Output("x".to_owned())),
                _ => EffectExpr::Set(some(self, 0), Expr::Literal(Value::Int(self.dice.below(3) as i64))),
            };
            if let Some(effects) = annotations.effects.get_mut(SUCCESS) {
                effects.push(effect);
            }
        }
    }

    /// Compares a value with a number and a half.
    pub(super) fn tolerated_comparison(&mut self) -> Expr {
        let key = Some(Expr::Literal(Value::Int(self.dice.below(2) as i64)));
        let fact = FactExpr { predicate: format!("p{TOLERANT}"), arguments: vec![key] };
        let limit = Expr::Literal(Value::Float(self.dice.below(3) as f64 + 0.5));
        let less = Expr::Binary(BinaryOperator::Less, Box::new(Expr::Fact(fact.clone())), Box::new(limit));
        Expr::Call(Function::If, vec![Expr::Exists(fact), less, Expr::Literal(Value::Bool(true))])
    }
}
