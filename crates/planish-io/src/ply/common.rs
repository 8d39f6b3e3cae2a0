//! Shared by reading and writing PLY.

use ply_rs_bw::ply::{Property, PropertyAccess, PropertyAccessResult};

use planish_core::{Attribute, FormatError};

/// A vertex or grid cell as it is read: its values in the order of the properties.
#[derive(Default)]
pub(super) struct Record(pub(super) Vec<Property>);

impl PropertyAccess for Record {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, _name: &str, property: Property) -> PropertyAccessResult {
        self.0.push(property);
        PropertyAccessResult::Set
    }
}

pub(super) fn malformed<T>(text: impl Into<String>) -> Result<T, FormatError> {
    Err(FormatError::Malformed(text.into()))
}

/// Names of normals in PLY files and in PCL.
pub(super) const NORMALS: [(&str, &str); 3] = [("nx", "normal_x"), ("ny", "normal_y"), ("nz", "normal_z")];

/// Gives the normals of a file PCL's names, by which the rest of the library knows them.
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
