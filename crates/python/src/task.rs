//! What Python needs of the language of task files: the tree of a file, its findings, its model, and the catalogue.
//!
//! Tracing a Python function, and writing YAML, is done in Python (`python/ratn/_task.py`); only `ratn-model` decides what a task means.
//! Results with many fields are passed to Python as JSON.

use crate::error::{Error, InvalidTask, line};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyList, PyString};
use ratn_model::catalogue::Catalogue;
use ratn_model::diagnostic::Diagnostic;
use ratn_model::expression::Function;
use ratn_model::load::{Document, Files, MAX_SOURCE, load_with};
use std::path::Path;

/// The tree of a task file: dicts, lists, texts, numbers and booleans. Invalid YAML raises `ratn.InvalidTask`.
#[pyfunction]
pub(crate) fn read_yaml<'py>(py: Python<'py>, text: &str, file: &str) -> PyResult<Bound<'py, PyAny>> {
    let document = Document::read(text, file);
    to_python(py, &document.map_err(|finding| InvalidTask::new_err(finding.to_string()))?)
}

fn to_python<'py>(py: Python<'py>, document: &Document) -> PyResult<Bound<'py, PyAny>> {
    Ok(match document {
        Document::Null => py.None().into_bound(py),
        Document::Bool(truth) => PyBool::new(py, *truth).to_owned().into_any(),
        Document::Int(number) => PyInt::new(py, *number).into_any(),
        Document::Float(number) => PyFloat::new(py, *number).into_any(),
        Document::Text(text) => PyString::new(py, text).into_any(),
        Document::List(items) => {
            let items = items.iter().map(|item| to_python(py, item)).collect::<PyResult<Vec<_>>>()?;
            PyList::new(py, items)?.into_any()
        }
        Document::Map(entries) => {
            let map = PyDict::new(py);
            for (key, value) in entries {
                map.set_item(key, to_python(py, value)?)?;
            }
            map.into_any()
        }
    })
}

/// The findings for a task file, and its model unless it is refused; both as JSON. Catalogues, as TOML, extend the built-in one; libraries
/// and ontologies are read from the folder of `file`.
#[pyfunction]
pub(crate) fn check_task(
    py: Python<'_>,
    text: &str,
    file: &str,
    catalogues: Vec<String>,
) -> PyResult<(String, Option<String>)> {
    let catalogue = composed(&catalogues)?;
    let (findings, program) = match py.detach(|| load_with(text, file, &catalogue, &Beside)) {
        Ok(loaded) => (loaded.warnings, Some(loaded.program)),
        Err(findings) => (findings, None),
    };
    let program = program.map(|program| json(&program)).transpose()?;
    let findings: Vec<(Diagnostic, String)> =
        findings.into_iter().map(|finding| (finding.clone(), finding.to_string())).collect();
    Ok((json(&findings)?, program))
}

/// The built-in catalogue, extended by others in TOML, as JSON.
#[pyfunction]
pub(crate) fn catalogue(catalogues: Vec<String>) -> PyResult<String> {
    json(&composed(&catalogues)?)
}

/// The names of the functions of expressions.
#[pyfunction]
pub(crate) fn functions() -> Vec<&'static str> {
    Function::ALL.into_iter().map(Function::name).collect()
}

fn composed(catalogues: &[String]) -> PyResult<Catalogue> {
    let mut composed = Catalogue::standard();
    for text in catalogues {
        let said = Catalogue::from_toml(text).map_err(|error| Error::new_err(line(&error)))?;
        for (name, provider) in said.providers {
            let known = composed.providers.entry(name).or_insert_with(|| provider.clone());
            known.resource = provider.resource;
            known.actions.extend(provider.actions);
        }
        composed.resources.extend(said.resources);
    }
    Ok(composed)
}

pub(crate) fn json(value: &impl serde::Serialize) -> PyResult<String> {
    serde_json::to_string(value).map_err(|error| Error::new_err(line(&error)))
}

/// Reads libraries and ontologies relative to the files that use them.
struct Beside;

impl Files for Beside {
    fn read(&self, using: &str, path: &str) -> Result<(String, String), String> {
        let file = Path::new(using).parent().unwrap_or(Path::new("")).join(path);
        let text = read(&file).map_err(|error| error.to_string())?;
        // Different paths to the same file have to be equal.
        Ok((file.canonicalize().unwrap_or(file).display().to_string(), text))
    }
}

fn read(file: &Path) -> std::io::Result<String> {
    ratn_regular_file::read_text(file, MAX_SOURCE)
}
