//! The native part of the Python package `ratn`: the clients and the worker.
//!
//! It wraps `ratn-worker`, so that leases, fencing, sessions, drain and signals use the same code as in every other worker. It owns the
//! conversion between Python objects and the values of a system ([`value`]), and releases Python's lock during every wait. Python code in
//! `python/ratn` does the rest (annotations, decorators, `async def`, processes).

mod client;
mod error;
mod goal;
mod log;
mod numbers;
mod patience;
mod process;
mod task;
mod threads;
mod value;
mod worker;

use pyo3::prelude::*;

#[pymodule]
fn _ratn(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add_class::<value::Pose>()?;
    module.add_class::<value::Joints>()?;
    module.add_class::<value::Trajectory>()?;
    module.add_class::<numbers::Numbers>()?;
    module.add_class::<value::Fact>()?;
    module.add_class::<goal::Goal>()?;
    module.add_class::<client::Client>()?;
    module.add_class::<client::Lease>()?;
    module.add_class::<client::WorldWatch>()?;
    module.add_class::<client::Projected>()?;
    module.add_class::<log::Log>()?;
    module.add_class::<process::Process>()?;
    module.add_function(wrap_pyfunction!(patience::patience_s, module)?)?;
    module.add_function(wrap_pyfunction!(worker::serve, module)?)?;
    module.add_function(wrap_pyfunction!(task::read_yaml, module)?)?;
    module.add_function(wrap_pyfunction!(task::check_task, module)?)?;
    module.add_function(wrap_pyfunction!(task::catalogue, module)?)?;
    module.add_function(wrap_pyfunction!(task::functions, module)?)?;
    error::add_to(py, module)
}
