//! The rest of a PLY header: free text, which is kept, and unsupported elements, which are dropped.

use super::super::brief;
use super::header::{Header, Kind};
use planish_core::Provenance;

/// Free text lines of a PLY header, except those that state the grid.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Remarks {
    pub(super) comments: Vec<String>,
    pub(super) obj_infos: Vec<String>,
}

/// Elements that are read; all others are dropped.
const KEPT: [&str; 3] = ["vertex", "range_grid", "camera"];
pub(super) const GRID_INFOS: [&str; 2] = ["num_cols", "num_rows"];

impl Remarks {
    /// Converts the lines to a cloud's provenance, which is empty if there are no lines.
    pub(super) fn into_provenance(self) -> Provenance {
        if self == Self::default() { Provenance::default() } else { Provenance::new(self) }
    }
}

/// Returns notes for users on dropped elements and lists.
pub(super) fn left_out(header: &Header) -> Vec<String> {
    let properties = header.element("vertex").map_or(&[][..], |vertex| &vertex.properties);
    let lists = properties.iter().filter(|property| matches!(property.kind, Kind::List { .. }));
    let lists: Vec<String> = lists.map(|property| brief(&property.name)).collect();
    let others = header.elements.iter().filter(|element| !KEPT.contains(&element.name.as_str()) && element.count > 0);
    let others: Vec<String> = others.map(|element| format!("{} ({})", brief(&element.name), element.count)).collect();
    let of_elements =
        (!others.is_empty()).then(|| format!("elements other than vertices are dropped: {}", others.join(", ")));
    let of_lists =
        (!lists.is_empty()).then(|| format!("list properties of the vertices are dropped: {}", lists.join(", ")));
    of_elements.into_iter().chain(of_lists).collect()
}

/// Returns the free text of a header, except lines that state the grid.
pub(super) fn remarks_of(header: &Header) -> Remarks {
    let is_of_grid = |line: &&String| GRID_INFOS.iter().any(|key| line.trim().starts_with(key));
    let obj_infos = header.obj_infos.iter().filter(|line| !is_of_grid(line)).cloned().collect();
    Remarks { comments: header.comments.clone(), obj_infos }
}
