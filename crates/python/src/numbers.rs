//! Numbers and bytes in contiguous memory, which numpy views without a copy; and the reading of numpy arrays.
//!
//! Values that come from a system keep their memory as long as an array uses it, and are never written to: the arrays are read-only. Values
//! that an action returns are copied once: the action may change its array afterwards. numpy is neither needed nor imported here; its
//! arrays are recognised by their protocol (`__array_interface__`, version 3).

use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyList, PyTuple};
use ratn_model::list::List;
use ratn_model::value::Value;
use ratn_proto::types::FactRecord;
use std::ops::Deref;
use std::sync::Arc;

const ORDER: char = if cfg!(target_endian = "little") { '<' } else { '>' };

/// Floats in shared, immutable memory.
#[derive(Clone, Debug)]
pub(crate) enum Floats {
    /// In memory of their own.
    Own(Arc<Vec<f64>>),
    /// Within a fact, with the function that finds them there.
    Of(Arc<FactRecord>, fn(&FactRecord) -> &[f64]),
}

impl From<Vec<f64>> for Floats {
    fn from(floats: Vec<f64>) -> Floats {
        Floats::Own(Arc::new(floats))
    }
}

impl Deref for Floats {
    type Target = [f64];

    fn deref(&self) -> &[f64] {
        match self {
            Floats::Own(floats) => floats,
            Floats::Of(fact, within) => within(fact),
        }
    }
}

impl Floats {
    /// The array interface, of which numpy makes an array without a copy: the array keeps the Python object alive, and the memory does not
    /// move.
    pub(crate) fn interface<'py>(&self, py: Python<'py>, shape: &[usize]) -> PyResult<Bound<'py, PyDict>> {
        interface(py, "f8", self.as_ptr() as usize, shape)
    }
}

fn interface<'py>(py: Python<'py>, kind: &str, address: usize, shape: &[usize]) -> PyResult<Bound<'py, PyDict>> {
    let told = PyDict::new(py);
    told.set_item("version", 3)?;
    told.set_item("shape", PyTuple::new(py, shape)?)?;
    told.set_item("typestr", format!("{}{kind}", if kind == "u1" { '|' } else { ORDER }))?;
    // Read-only.
    told.set_item("data", (address, true))?;
    Ok(told)
}

#[derive(Clone, Debug)]
enum Memory {
    Floats(Floats),
    Bytes(Arc<Vec<u8>>),
}

/// Numbers from a system: a row, or a matrix as its rows. `numpy.asarray(numbers)` is a read-only view without a copy.
#[pyclass(frozen, sequence, module = "ratn")]
#[derive(Debug)]
pub(crate) struct Numbers {
    memory: Memory,
    /// One length, or rows and columns.
    shape: Vec<usize>,
}

impl Numbers {
    /// A vector of all floats.
    pub(crate) fn row(floats: Floats) -> Numbers {
        let shape = vec![floats.len()];
        Numbers { memory: Memory::Floats(floats), shape }
    }

    /// A matrix with this number of columns, row by row.
    pub(crate) fn matrix(floats: Floats, columns: usize) -> Numbers {
        let shape = vec![floats.len().checked_div(columns).unwrap_or_default(), columns];
        Numbers { memory: Memory::Floats(floats), shape }
    }

    /// A square matrix; a vector if the number of floats is not a square.
    pub(crate) fn square(floats: Floats) -> Numbers {
        let side = floats.len().isqrt();
        if side * side == floats.len() { Numbers::matrix(floats, side) } else { Numbers::row(floats) }
    }

    /// A value for an array: bytes, a list of numbers, or lists of equal length. Any other value is returned as the error.
    pub(crate) fn of(value: Value) -> Result<Numbers, Value> {
        match value {
            Value::Bytes(bytes) => Ok(Numbers { shape: vec![bytes.len()], memory: Memory::Bytes(Arc::new(bytes)) }),
            Value::List(items) => match floats_of(&items) {
                Some((floats, shape)) => Ok(Numbers { memory: Memory::Floats(floats.into()), shape }),
                None => Err(Value::List(items)),
            },
            other => Err(other),
        }
    }

    /// Converts back to a value of the system.
    pub(crate) fn value(&self) -> Value {
        let floats = match &self.memory {
            Memory::Bytes(bytes) => return Value::Bytes(bytes.to_vec()),
            Memory::Floats(floats) => floats,
        };
        nested(floats, &self.shape)
    }

    /// The floats, one after the other.
    pub(crate) fn floats(&self) -> Vec<f64> {
        match &self.memory {
            Memory::Bytes(bytes) => bytes.iter().map(|byte| f64::from(*byte)).collect(),
            Memory::Floats(floats) => floats.to_vec(),
        }
    }

    /// Elements from an index on, as a Python list.
    fn listed<'py>(&self, py: Python<'py>, from: usize, length: usize) -> PyResult<Bound<'py, PyList>> {
        match &self.memory {
            Memory::Bytes(bytes) => PyList::new(py, &bytes[from..from + length]),
            Memory::Floats(floats) => PyList::new(py, &floats[from..from + length]),
        }
    }
}

#[pymethods]
impl Numbers {
    /// The number of elements; for a matrix the numbers of rows and columns.
    #[getter]
    fn shape<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, &self.shape)
    }

    fn __len__(&self) -> usize {
        self.shape[0]
    }

    /// A number, or a row of a matrix as a list.
    fn __getitem__<'py>(&self, py: Python<'py>, index: isize) -> PyResult<Bound<'py, PyAny>> {
        let place = place(index, self.shape[0]).ok_or_else(|| PyIndexError::new_err("there is no such number"))?;
        match self.shape.get(1) {
            Some(columns) => Ok(self.listed(py, place * columns, *columns)?.into_any()),
            None => self.listed(py, place, 1)?.get_item(0),
        }
    }

    /// As a list of numbers, or of rows.
    fn tolist<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let Some(columns) = self.shape.get(1) else { return self.listed(py, 0, self.shape[0]) };
        let rows = (0..self.shape[0]).map(|row| self.listed(py, row * columns, *columns));
        PyList::new(py, rows.collect::<PyResult<Vec<_>>>()?)
    }

    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        match &self.memory {
            Memory::Floats(floats) => floats.interface(py, &self.shape),
            Memory::Bytes(bytes) => interface(py, "u1", bytes.as_ptr() as usize, &self.shape),
        }
    }

    fn __eq__(&self, other: &Numbers) -> bool {
        let same = match (&self.memory, &other.memory) {
            (Memory::Floats(own), Memory::Floats(others)) => own[..] == others[..],
            (Memory::Bytes(own), Memory::Bytes(others)) => own == others,
            (Memory::Floats(_), Memory::Bytes(_)) | (Memory::Bytes(_), Memory::Floats(_)) => false,
        };
        same && self.shape == other.shape
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        Ok(format!("Numbers({})", self.tolist(py)?.repr()?))
    }
}

/// The index of an element; a negative index counts from the end.
pub(crate) fn place(index: isize, length: usize) -> Option<usize> {
    let place = if index < 0 { length.checked_sub(index.unsigned_abs())? } else { usize::try_from(index).ok()? };
    (place < length).then_some(place)
}

/// Reads numbers from a Python object: an array, or anything iterable with numbers, also lists row by row.
pub(crate) fn taken(object: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    if let Ok(numbers) = object.cast::<Numbers>() {
        return Ok(numbers.get().floats());
    }
    if let Some((floats, _)) = array(object)? {
        return Ok(floats);
    }
    let row = |row: Bound<'_, PyAny>| row.try_iter()?.map(|item| item?.extract()).collect::<PyResult<Vec<f64>>>();
    let rows = object.try_iter()?.map(|item| {
        let item = item?;
        item.extract().map(|number| vec![number]).or_else(|_| row(item))
    });
    Ok(rows.collect::<PyResult<Vec<_>>>()?.concat())
}

/// The floats of a numpy array, and its shape. `None` for another object, or an array of another type.
pub(crate) fn array(object: &Bound<'_, PyAny>) -> PyResult<Option<(Vec<f64>, Vec<usize>)>> {
    let Ok(told) = object.getattr("__array_interface__") else { return Ok(None) };
    let (Ok(kind), Ok(shape)) = (told.get_item("typestr"), told.get_item("shape")) else { return Ok(None) };
    let (kind, shape): (String, Vec<usize>) = (kind.extract()?, shape.extract()?);
    let read: fn(&[u8]) -> Vec<f64> = match kind.strip_prefix(ORDER) {
        Some("f8") => |bytes| bytes.as_chunks().0.iter().map(|one| f64::from_ne_bytes(*one)).collect(),
        Some("f4") => |bytes| bytes.as_chunks().0.iter().map(|one| f64::from(f32::from_ne_bytes(*one))).collect(),
        _ => return Ok(None),
    };
    if shape.is_empty() {
        return Ok(None);
    }
    // Row by row, whatever the memory layout.
    let bytes = object.call_method0("tobytes")?;
    let floats = read(bytes.cast::<PyBytes>()?.as_bytes());
    if floats.len() != shape.iter().product::<usize>() {
        return Err(PyValueError::new_err("an array has another size than it says"));
    }
    Ok(Some((floats, shape)))
}

/// Floats as nested lists, row by row.
pub(crate) fn nested(floats: &[f64], shape: &[usize]) -> Value {
    match shape {
        [] | [_] => Value::List(floats.iter().copied().map(Value::Float).collect()),
        [rows, inner @ ..] => {
            let length = floats.len().checked_div(*rows).unwrap_or_default();
            Value::List((0..*rows).map(|row| nested(&floats[row * length..(row + 1) * length], inner)).collect())
        }
    }
}

/// Numbers with their shape, from a list of numbers or of rows with equal length.
fn floats_of(items: &List) -> Option<(Vec<f64>, Vec<usize>)> {
    let row = |items: &List| items.iter().map(Value::as_number).collect::<Option<Vec<f64>>>();
    let Some(Value::List(first)) = items.first() else { return Some((row(items)?, vec![items.len()])) };
    let mut floats = Vec::with_capacity(items.len() * first.len());
    for item in items {
        match item {
            Value::List(items) if items.len() == first.len() => floats.extend(row(items)?),
            _ => return None,
        }
    }
    Some((floats, vec![items.len(), first.len()]))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    /// The address of an object's numbers, from its array interface.
    fn address(object: &Bound<'_, PyAny>) -> usize {
        let told = object.getattr("__array_interface__").unwrap();
        told.get_item("data").unwrap().get_item(0).unwrap().extract().unwrap()
    }

    #[test]
    fn what_comes_from_a_system_is_looked_at_where_it_lies() {
        Python::initialize();
        Python::attach(|py| {
            let picture = vec![1, 2, 3];
            let place = picture.as_ptr() as usize;
            let numbers = Numbers::of(Value::Bytes(picture)).unwrap();
            assert_eq!(address(Bound::new(py, numbers).unwrap().as_any()), place);
            let positions = vec![0.5, 1.5];
            let place = positions.as_ptr() as usize;
            let joints = crate::value::to_python(py, Value::Joints(positions)).unwrap();
            assert_eq!(address(&joints), place);
        });
    }

    #[test]
    fn lists_of_numbers_and_of_rows_are_numbers_and_others_stay_what_they_are() {
        let list = |items: &[Value]| Value::List(items.to_vec().into());
        let row = list(&[Value::Int(1), Value::Float(2.5)]);
        let of = |value: Value| Numbers::of(value).map(|numbers| (numbers.floats(), numbers.shape));
        assert_eq!(of(row.clone()), Ok((vec![1.0, 2.5], vec![2])));
        assert_eq!(of(list(&[row.clone(), row.clone()])), Ok((vec![1.0, 2.5, 1.0, 2.5], vec![2, 2])));
        assert_eq!(of(list(&[])), Ok((Vec::new(), vec![0])));
        assert_eq!(of(list(&[list(&[]), list(&[])])), Ok((Vec::new(), vec![2, 0])));
        for other in [list(&[row.clone(), Value::Int(1)]), list(&[row, list(&[])]), list(&[Value::Null])] {
            assert_eq!(of(other.clone()), Err(other));
        }
    }
}
