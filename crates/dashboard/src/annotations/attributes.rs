//! The extended attributes of a file: access control lists beside the mode, security labels, and users' own attributes.

use rustix::fs::{XattrFlags, fgetxattr, flistxattr, fremovexattr, fsetxattr};
use rustix::io::Errno;
use std::collections::BTreeMap;
use std::ffi::CString;
use std::fs::File;

/// Maximum size of the list of names, and of a value.
const MOST_BYTES: usize = 64 << 10;

/// Copies the extended attributes of an old file to a new one, and removes all others there.
///
/// # Errors
/// The name of an attribute that cannot be copied, and the error.
pub(super) fn keep(old: &File, new: &File) -> Result<(), String> {
    let (kept, own) = (all(old)?, all(new)?);
    for (name, value) in &kept {
        if own.get(name) != Some(value) {
            fsetxattr(new, name, value, XattrFlags::empty()).map_err(|error| failed(name, error))?;
        }
    }
    // A folder may give new files an access control list; security labels are set by the system.
    let is_removed = |name: &&CString| !kept.contains_key(*name) && !name.as_bytes().starts_with(b"security.");
    own.keys().filter(is_removed).try_for_each(|name| fremovexattr(new, name).map_err(|error| failed(name, error)))
}

fn all(file: &File) -> Result<BTreeMap<CString, Vec<u8>>, String> {
    let mut bytes = vec![0; MOST_BYTES];
    let length = match flistxattr(file, &mut bytes[..]) {
        Ok(length) => length,
        // The file system does not support them.
        Err(Errno::OPNOTSUPP) => 0,
        Err(error) => return Err(format!("its extended attributes cannot be read: {error}")),
    };
    let names = bytes[..length].split(|byte| *byte == 0).filter(|name| !name.is_empty());
    let names: Vec<CString> = names.filter_map(|name| CString::new(name).ok()).collect();
    let mut value = |name: CString| {
        let length = fgetxattr(file, &name, &mut bytes[..]).map_err(|error| failed(&name, error))?;
        Ok((name, bytes[..length].to_vec()))
    };
    names.into_iter().map(&mut value).collect()
}

fn failed(name: &CString, error: Errno) -> String {
    format!("its extended attribute {} would be lost: {error}", name.to_string_lossy())
}
