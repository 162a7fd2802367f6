//! Converts the values of a system to Python objects, and back.
//!
//! | value | Python |
//! |---|---|
//! | null, bool, int, float, string, bytes | `None`, `bool`, `int`, `float`, `str`, `bytes` |
//! | list, map | `list`, `dict` with names as keys |
//! | pose, joints, trajectory | [`Pose`], [`Joints`], [`Trajectory`] |
//!
//! A numpy array is read from its memory ([`crate::numbers`]); for any other object with a method `tolist`, the result of that is used.

use crate::numbers::{self, Floats, Numbers};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBool, PyByteArray, PyBytes, PyDict, PyFloat, PyInt, PyList, PyString, PyTuple};
use ratn_model::fact::Term;
use ratn_model::measurement::Certainty;
use ratn_model::pose;
use ratn_model::value::{self, TrajectoryPoint, Value};
use ratn_proto::types::FactRecord;
use std::collections::{BTreeMap, HashSet};
use std::sync::{Arc, OnceLock};

/// Maximum nesting depth of lists and maps.
const MAX_DEPTH: usize = 32;
/// A quaternion whose length differs from 1 by less than this counts as normalised.
const UNIT: f64 = 1e-12;

/// A rigid pose: a position in metres and an orientation as a unit quaternion (x, y, z, w).
#[pyclass(frozen, from_py_object, module = "ratn")]
#[derive(Clone, Debug)]
pub(crate) struct Pose(pub(crate) pose::Pose);

#[pymethods]
impl Pose {
    /// `Pose(x, y, z)`, with roll, pitch and yaw in radians, or with `quaternion=(x, y, z, w)`.
    #[new]
    #[pyo3(signature = (x=0.0, y=0.0, z=0.0, roll=0.0, pitch=0.0, yaw=0.0, *, quaternion=None))]
    fn new(x: f64, y: f64, z: f64, roll: f64, pitch: f64, yaw: f64, quaternion: Option<[f64; 4]>) -> PyResult<Pose> {
        let Some(quaternion) = quaternion else { return Ok(Pose(pose::Pose::from_rpy([x, y, z], roll, pitch, yaw))) };
        let length = quaternion.iter().map(|part| part * part).sum::<f64>().sqrt();
        if [roll, pitch, yaw] != [0.0; 3] {
            return Err(PyValueError::new_err("an orientation is roll, pitch and yaw, or a quaternion, not both"));
        }
        if !(length.is_finite() && length > 1e-9) {
            return Err(PyValueError::new_err("quaternion: has no length; expected (x, y, z, w)"));
        }
        // A normalised quaternion stays as it is, so that a pose that was pickled or printed is read back unchanged.
        let length = if (length - 1.0).abs() < UNIT { 1.0 } else { length };
        let quaternion_xyzw = quaternion.map(|part| part / length);
        Ok(Pose(pose::Pose { position: [x, y, z], quaternion_xyzw }))
    }

    #[getter]
    fn x(&self) -> f64 {
        self.0.position[0]
    }

    #[getter]
    fn y(&self) -> f64 {
        self.0.position[1]
    }

    #[getter]
    fn z(&self) -> f64 {
        self.0.position[2]
    }

    /// The position in metres.
    #[getter]
    fn position(&self) -> (f64, f64, f64) {
        self.0.position.into()
    }

    /// The quaternion x, y, z, w.
    #[getter]
    fn quaternion(&self) -> (f64, f64, f64, f64) {
        self.0.quaternion_xyzw.into()
    }

    /// The distance between the positions in metres.
    fn distance(&self, other: &Pose) -> f64 {
        self.0.distance(&other.0)
    }

    /// The angle between the orientations in radians.
    fn angle(&self, other: &Pose) -> f64 {
        self.0.angle(&other.0)
    }

    /// The pose that is `other` as seen from this one.
    fn __matmul__(&self, other: &Pose) -> Pose {
        Pose(self.0.compose(&other.0))
    }

    /// The inverse pose: the reference frame in this frame.
    fn inverse(&self) -> Pose {
        Pose(self.0.inverse())
    }

    /// Transforms a point from this pose's frame to the reference frame.
    fn transform(&self, point: [f64; 3]) -> (f64, f64, f64) {
        self.0.transform(point).into()
    }

    fn __eq__(&self, other: &Pose) -> bool {
        self.0 == other.0
    }

    fn __hash__(&self, py: Python<'_>) -> PyResult<isize> {
        hash(py, &[self.0.position.as_slice(), &self.0.quaternion_xyzw].concat())
    }

    fn __getnewargs_ex__<'py>(&self, py: Python<'py>) -> PyResult<((f64, f64, f64), Bound<'py, PyDict>)> {
        let named = PyDict::new(py);
        named.set_item("quaternion", self.quaternion())?;
        Ok((self.position(), named))
    }

    fn __repr__(&self) -> String {
        let ([x, y, z], [a, b, c, d]) = (self.0.position, self.0.quaternion_xyzw);
        match [a, b, c, d] == pose::Pose::IDENTITY.quaternion_xyzw {
            true => format!("Pose({x}, {y}, {z})"),
            false => format!("Pose({x}, {y}, {z}, quaternion=({a}, {b}, {c}, {d}))"),
        }
    }
}

/// Positions of a robot's joints: radians, metres for prismatic ones, in the robot's order. `numpy.asarray(joints)` is a view without a copy.
#[pyclass(frozen, sequence, module = "ratn")]
#[derive(Debug)]
pub(crate) struct Joints(Floats);

#[pymethods]
impl Joints {
    #[new]
    fn new(positions: &Bound<'_, PyAny>) -> PyResult<Joints> {
        Ok(Joints(numbers::taken(positions)?.into()))
    }

    fn __len__(&self) -> usize {
        self.0.len()
    }

    fn __getitem__(&self, index: isize) -> PyResult<f64> {
        let found = numbers::place(index, self.0.len()).map(|place| self.0[place]);
        found.ok_or_else(|| pyo3::exceptions::PyIndexError::new_err("there is no such joint"))
    }

    /// As a list of floats.
    fn tolist(&self) -> Vec<f64> {
        self.0.to_vec()
    }

    /// What numpy makes an array of without a copy, which cannot be written to: the array keeps this alive, and nothing moves it.
    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.0.interface(py, &[self.0.len()])
    }

    fn __eq__(&self, other: &Joints) -> bool {
        self.0[..] == other.0[..]
    }

    fn __hash__(&self, py: Python<'_>) -> PyResult<isize> {
        hash(py, &self.0)
    }

    fn __getnewargs__(&self) -> (Vec<f64>,) {
        (self.tolist(),)
    }

    fn __repr__(&self) -> String {
        format!("Joints({:?})", &self.0[..])
    }
}

/// A timed path in joint space: joint names, and points of seconds, positions (radians) and velocities (radians per second).
#[pyclass(frozen, module = "ratn")]
#[derive(Debug)]
pub(crate) struct Trajectory {
    value: value::Trajectory,
    columns: OnceLock<Columns>,
}

/// A point in Python: seconds, positions, velocities.
type Point = (f64, Vec<f64>, Vec<f64>);

/// The columns of a trajectory, made when they are first asked for.
#[derive(Debug)]
struct Columns {
    times_s: Floats,
    positions: Floats,
    /// `None` if any point has no velocities.
    velocities: Option<Floats>,
}

impl From<value::Trajectory> for Trajectory {
    fn from(value: value::Trajectory) -> Trajectory {
        Trajectory { value, columns: OnceLock::new() }
    }
}

impl Trajectory {
    fn columns(&self) -> &Columns {
        self.columns.get_or_init(|| {
            let (points, width) = (&self.value.points, self.value.joints.len());
            let all = |of: fn(&TrajectoryPoint) -> &[f64]| {
                let mut floats = Vec::with_capacity(points.len() * width);
                points.iter().for_each(|point| floats.extend_from_slice(of(point)));
                Floats::from(floats)
            };
            let velocities = points.iter().all(|point| point.velocities.len() == width);
            Columns {
                times_s: points.iter().map(|point| point.time_s).collect::<Vec<_>>().into(),
                positions: all(|point| &point.positions),
                velocities: velocities.then(|| all(|point| &point.velocities)),
            }
        })
    }

    /// Points made from contiguous rows, one per point; without velocities if there are none.
    fn of_columns(
        joints: Vec<String>,
        times_s: &[f64],
        positions: Vec<f64>,
        velocities: Option<Vec<f64>>,
    ) -> PyResult<Trajectory> {
        let width = joints.len();
        for (name, row) in [("positions", Some(&positions)), ("velocities", velocities.as_ref())] {
            let Some(row) = row else { continue };
            if row.len() != width * times_s.len() {
                let (points, numbers) = (times_s.len(), row.len());
                let wrong = format!(
                    "{name}: {points} points of {width} joints need as many rows and columns, and these are {numbers} numbers"
                );
                return Err(PyValueError::new_err(wrong));
            }
        }
        let row = |rows: &[f64], number: usize| rows[number * width..(number + 1) * width].to_vec();
        let point = |(number, time_s): (usize, &f64)| TrajectoryPoint {
            time_s: *time_s,
            positions: row(&positions, number),
            velocities: velocities.as_ref().map(|velocities| row(velocities, number)).unwrap_or_default(),
        };
        let points = times_s.iter().enumerate().map(point).collect();
        Ok(value::Trajectory { joints, points }.into())
    }
}

#[pymethods]
impl Trajectory {
    /// `Trajectory(joints, [(time_s, positions, velocities), …])`, or `Trajectory(joints, times_s=…, positions=…, velocities=…)` with arrays or lists: a
    /// row for each point, a column for each joint. Velocities may be left out (of a point: `[]`).
    #[new]
    #[pyo3(signature = (joints, points=None, *, times_s=None, positions=None, velocities=None))]
    fn new(
        joints: Vec<String>,
        points: Option<Vec<Point>>,
        times_s: Option<&Bound<'_, PyAny>>,
        positions: Option<&Bound<'_, PyAny>>,
        velocities: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Trajectory> {
        let points = match (points, times_s, positions, velocities) {
            (Some(points), None, None, None) => points,
            (None, Some(times_s), Some(positions), velocities) => {
                let (times_s, positions) = (numbers::taken(times_s)?, numbers::taken(positions)?);
                return Trajectory::of_columns(
                    joints,
                    &times_s,
                    positions,
                    velocities.map(numbers::taken).transpose()?,
                );
            }
            _ => return Err(PyTypeError::new_err("say `points`, or `times_s`, `positions` and perhaps `velocities`")),
        };
        let width = joints.len();
        let mut taken = Vec::with_capacity(points.len());
        for (number, (time_s, positions, velocities)) in points.into_iter().enumerate() {
            if positions.len() != width || (velocities.len() != width && !velocities.is_empty()) {
                let wrong =
                    format!("points[{number}]: {width} joints need as many positions, and as many velocities or none");
                return Err(PyValueError::new_err(wrong));
            }
            taken.push(TrajectoryPoint { time_s, positions, velocities });
        }
        Ok(value::Trajectory { joints, points: taken }.into())
    }

    #[getter]
    fn joints(&self) -> Vec<String> {
        self.value.joints.clone()
    }

    /// A tuple `(time_s, positions, velocities)` for each point.
    #[getter]
    fn points(&self) -> Vec<Point> {
        let point = |point: &TrajectoryPoint| (point.time_s, point.positions.clone(), point.velocities.clone());
        self.value.points.iter().map(point).collect()
    }

    /// Seconds from the start of the motion for each point. numpy can use them without a copy.
    #[getter]
    fn times_s(&self) -> Numbers {
        Numbers::row(self.columns().times_s.clone())
    }

    /// Radians (metres for prismatic joints): one row per point, one column per joint. numpy can use them without a copy.
    #[getter]
    fn positions(&self) -> Numbers {
        Numbers::matrix(self.columns().positions.clone(), self.value.joints.len())
    }

    /// Radians (metres) per second, arranged like the positions; `None` if a point has none.
    #[getter]
    fn velocities(&self) -> Option<Numbers> {
        let velocities = self.columns().velocities.clone()?;
        Some(Numbers::matrix(velocities, self.value.joints.len()))
    }

    /// Seconds from the first point to the last.
    #[getter]
    fn duration_s(&self) -> f64 {
        self.value.duration_s()
    }

    fn __eq__(&self, other: &Trajectory) -> bool {
        self.value == other.value
    }

    fn __hash__(&self, py: Python<'_>) -> PyResult<isize> {
        hash(py, &self.columns().times_s)
    }

    fn __getnewargs__(&self) -> (Vec<String>, Vec<Point>) {
        (self.joints(), self.points())
    }

    fn __repr__(&self) -> String {
        let (joints, points) = (self.value.joints.len(), self.value.points.len());
        format!("Trajectory({joints} joints, {points} points, {} s)", self.duration_s())
    }
}

/// A fact of a world: `at(box_1) = pose(…)` has the predicate `at`, the key `("box_1",)` and a `Pose` as its value.
#[pyclass(frozen, module = "ratn")]
pub(crate) struct Fact {
    record: Arc<FactRecord>,
    /// Converted on demand: of most facts only the key is used.
    value: PyOnceLock<Py<PyAny>>,
}

impl Fact {
    pub(crate) fn all(records: Vec<FactRecord>) -> Vec<Fact> {
        records.into_iter().map(|record| Fact { record: Arc::new(record), value: PyOnceLock::new() }).collect()
    }

    fn made(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        match &self.record.value {
            Value::Joints(_) => {
                let positions = Floats::Of(Arc::clone(&self.record), positions);
                Ok(Bound::new(py, Joints(positions))?.into_any().unbind())
            }
            value => to_python(py, value.clone()).map(Bound::unbind),
        }
    }
}

#[pymethods]
impl Fact {
    #[getter]
    fn predicate(&self) -> &str {
        &self.record.key.predicate
    }

    /// The arguments, in order.
    #[getter]
    fn key<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let terms = self.record.key.arguments.iter().map(|term| match term {
            Term::Int(number) => Ok(number.into_pyobject(py)?.into_any()),
            Term::Name(name) => Ok(PyString::new(py, name).into_any()),
        });
        PyTuple::new(py, terms.collect::<PyResult<Vec<_>>>()?)
    }

    #[getter]
    fn value(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        Ok(self.value.get_or_try_init(py, || self.made(py))?.clone_ref(py))
    }

    /// The revision of the world that wrote it.
    #[getter]
    fn revision(&self) -> u64 {
        self.record.revision.0
    }

    /// The source of the measurement; `None` if the fact was not measured.
    #[getter]
    fn source(&self) -> Option<String> {
        self.record.measured.as_ref().map(|measured| measured.source.clone())
    }

    /// The covariance of its numbers, if its source gave one: a square matrix that numpy can use without a copy.
    #[getter]
    fn covariance(&self) -> Option<Numbers> {
        let is_told = !covariance(&self.record).is_empty();
        is_told.then(|| Numbers::square(Floats::Of(Arc::clone(&self.record), covariance)))
    }

    /// The probability that it is true, if its source gave one.
    #[getter]
    fn confidence(&self) -> Option<f64> {
        match self.record.measured.as_ref()?.certainty.as_ref()? {
            Certainty::Confidence(confidence) => Some(*confidence),
            Certainty::Covariance(_) => None,
        }
    }

    fn __repr__(&self) -> String {
        format!("<Fact {} = {}>", self.record.key, self.record.value)
    }
}

/// The joint positions in a fact's value; empty for another type of value.
fn positions(record: &FactRecord) -> &[f64] {
    if let Value::Joints(positions) = &record.value { positions } else { &[] }
}

/// The covariance of a fact, row by row; empty without one.
fn covariance(record: &FactRecord) -> &[f64] {
    match record.measured.as_ref().and_then(|measured| measured.certainty.as_ref()) {
        Some(Certainty::Covariance(entries)) => entries,
        Some(Certainty::Confidence(_)) | None => &[],
    }
}

/// Converts a value to Python. Values with numbers keep their memory.
pub(crate) fn to_python(py: Python<'_>, value: Value) -> PyResult<Bound<'_, PyAny>> {
    Ok(match value {
        Value::Null => py.None().into_bound(py),
        Value::Bool(truth) => PyBool::new(py, truth).to_owned().into_any(),
        Value::Int(number) => number.into_pyobject(py)?.into_any(),
        Value::Float(number) => PyFloat::new(py, number).into_any(),
        Value::String(text) => PyString::new(py, &text).into_any(),
        Value::Pose(pose) => Bound::new(py, Pose(pose))?.into_any(),
        Value::Joints(positions) => Bound::new(py, Joints(positions.into()))?.into_any(),
        Value::Trajectory(trajectory) => Bound::new(py, Trajectory::from(trajectory))?.into_any(),
        Value::List(items) => {
            let items = items.into_iter().map(|item| to_python(py, item)).collect::<PyResult<Vec<_>>>()?;
            PyList::new(py, items)?.into_any()
        }
        Value::Map(fields) => fields_to_python(py, fields)?.into_any(),
        Value::Bytes(bytes) => PyBytes::new(py, &bytes).into_any(),
    })
}

/// Converts ports, or the fields of a map, to Python.
pub(crate) fn fields_to_python(py: Python<'_>, fields: BTreeMap<String, Value>) -> PyResult<Bound<'_, PyDict>> {
    let taken = PyDict::new(py);
    for (name, value) in fields {
        taken.set_item(name, to_python(py, value)?)?;
    }
    Ok(taken)
}

/// Converts the inputs of a goal to Python. Those named in `arrays` become objects that numpy views without a copy.
pub(crate) fn inputs_to_python<'py>(
    py: Python<'py>,
    inputs: BTreeMap<String, Value>,
    arrays: &HashSet<String>,
) -> PyResult<Bound<'py, PyDict>> {
    let taken = PyDict::new(py);
    for (name, value) in inputs {
        let value = if arrays.contains(&name) { Numbers::of(value) } else { Err(value) };
        match value {
            Ok(numbers) => taken.set_item(name, Bound::new(py, numbers)?)?,
            Err(value) => taken.set_item(name, to_python(py, value)?)?,
        }
    }
    Ok(taken)
}

/// Python's hash of numbers, for which 0 and -0 are equal.
fn hash(py: Python<'_>, numbers: &[f64]) -> PyResult<isize> {
    PyTuple::new(py, numbers)?.hash()
}

/// Converts a Python object to a value.
pub(crate) fn from_python(object: &Bound<'_, PyAny>) -> PyResult<Value> {
    taken(object, 0)
}

/// Converts a Python dict to ports.
pub(crate) fn fields_from_python(fields: &Bound<'_, PyDict>) -> PyResult<BTreeMap<String, Value>> {
    named(fields, 0)
}

fn named(fields: &Bound<'_, PyDict>, depth: usize) -> PyResult<BTreeMap<String, Value>> {
    let mut found = BTreeMap::new();
    for (name, value) in fields.iter() {
        let name = name.cast::<PyString>().map_err(|_| PyTypeError::new_err("the keys of a map are names (str)"))?;
        let name = name.to_str()?.to_owned();
        let value = taken(&value, depth)
            .map_err(|error| PyTypeError::new_err(format!("`{name}`: {}", error.value(fields.py()))))?;
        found.insert(name, value);
    }
    Ok(found)
}

fn taken(object: &Bound<'_, PyAny>, depth: usize) -> PyResult<Value> {
    if depth > MAX_DEPTH {
        return Err(PyTypeError::new_err(format!("a value has at most {MAX_DEPTH} levels")));
    }
    let items = |items: Vec<Bound<'_, PyAny>>| {
        items.iter().map(|item| taken(item, depth + 1)).collect::<PyResult<_>>().map(Value::List)
    };
    if object.is_none() {
        return Ok(Value::Null);
    }
    if let Ok(truth) = object.cast::<PyBool>() {
        return Ok(Value::Bool(truth.is_true()));
    }
    if object.is_instance_of::<PyInt>() {
        let number = object.extract();
        return number.map(Value::Int).map_err(|_| PyValueError::new_err(format!("{object} has more than 64 bits")));
    }
    if object.is_instance_of::<PyFloat>() {
        return object.extract().map(Value::Float);
    }
    if let Ok(text) = object.cast::<PyString>() {
        return Ok(Value::String(text.to_str()?.to_owned()));
    }
    if let Ok(bytes) = object.cast::<PyBytes>() {
        return Ok(Value::Bytes(bytes.as_bytes().to_vec()));
    }
    if let Ok(bytes) = object.cast::<PyByteArray>() {
        return Ok(Value::Bytes(bytes.to_vec()));
    }
    if let Ok(pose) = object.cast::<Pose>() {
        return Ok(Value::Pose(pose.get().0));
    }
    if let Ok(joints) = object.cast::<Joints>() {
        return Ok(Value::Joints(joints.get().0.to_vec()));
    }
    if let Ok(trajectory) = object.cast::<Trajectory>() {
        return Ok(Value::Trajectory(trajectory.get().value.clone()));
    }
    if let Ok(numbers) = object.cast::<Numbers>() {
        return Ok(numbers.get().value());
    }
    if let Ok(fields) = object.cast::<PyDict>() {
        return named(fields, depth + 1).map(Value::Map);
    }
    if let Ok(list) = object.cast::<PyList>() {
        return items(list.iter().collect());
    }
    if let Ok(tuple) = object.cast::<PyTuple>() {
        return items(tuple.iter().collect());
    }
    if let Some((floats, shape)) = numbers::array(object)? {
        return Ok(numbers::nested(&floats, &shape));
    }
    if object.hasattr("tolist")? {
        return taken(&object.call_method0("tolist")?, depth + 1);
    }
    let kind = object.get_type().name()?;
    Err(PyTypeError::new_err(format!(
        "a {kind} is no value of a system: expected None, bool, int, float, str, bytes, list, dict, Pose, Joints, Trajectory or an array"
    )))
}
