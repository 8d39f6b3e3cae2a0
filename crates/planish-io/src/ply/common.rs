//! Code shared by the reader and the writer of PLY files.

use planish_core::{Attribute, FormatError};

pub(super) fn malformed<T>(text: impl Into<String>) -> Result<T, FormatError> {
    Err(FormatError::Malformed(text.into()))
}

/// Names of the components of normals, in PLY files and in PCL.
pub(super) const NORMALS: [(&str, &str); 3] = [("nx", "normal_x"), ("ny", "normal_y"), ("nz", "normal_z")];

/// Renames a file's normals to PCL's names, which the rest of the library uses.
pub(super) fn rename_normals(columns: &mut [Attribute]) {
    let has = |name: &str| columns.iter().any(|column| column.name == name);
    if NORMALS.iter().all(|(ply, pcl)| has(ply) && !has(pcl)) {
        for column in columns {
            if let Some((_, pcl)) = NORMALS.iter().find(|(ply, _)| column.name == *ply) {
                column.name = (*pcl).to_owned();
            }
        }
    }
}
