//! Format-specific data of a file, which the cloud carries from the reader to the writer.

use std::any::Any;
use std::fmt;
use std::sync::Arc;

/// Data of one file format that travels with a cloud: a LAS header, the scans of an E57 file, the comments of a PLY
/// file.
///
/// The format that stored a value retrieves it by its type; all other code passes the value on unchanged. Clones
/// share the value.
///
/// ```
/// use planish_core::Provenance;
///
/// #[derive(Debug, PartialEq)]
/// struct Comments(Vec<String>);
///
/// let provenance = Provenance::new(Comments(vec!["by hand".to_owned()]));
/// assert_eq!(provenance.get::<Comments>().map(|comments| comments.0.len()), Some(1));
/// assert_eq!(provenance.get::<String>(), None);
/// ```
#[derive(Clone, Default)]
pub struct Provenance(Option<Arc<dyn FormatData>>);

impl Provenance {
    /// Stores the data of a format.
    pub fn new<T: Any + fmt::Debug + PartialEq + Send + Sync>(data: T) -> Self {
        Self(Some(Arc::new(data)))
    }

    /// Returns the data, if it has this type.
    pub fn get<T: Any>(&self) -> Option<&T> {
        self.0.as_ref()?.as_any().downcast_ref()
    }

    /// Returns true if no format stored data.
    pub fn is_empty(&self) -> bool {
        self.0.is_none()
    }
}

impl PartialEq for Provenance {
    fn eq(&self, other: &Self) -> bool {
        match (&self.0, &other.0) {
            (None, None) => true,
            (Some(own), Some(other)) => Arc::ptr_eq(own, other) || own.equals(other.as_any()),
            _ => false,
        }
    }
}

impl fmt::Debug for Provenance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

trait FormatData: fmt::Debug + Send + Sync {
    fn as_any(&self) -> &dyn Any;
    fn equals(&self, other: &dyn Any) -> bool;
}

impl<T: Any + fmt::Debug + PartialEq + Send + Sync> FormatData for T {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn equals(&self, other: &dyn Any) -> bool {
        other.downcast_ref() == Some(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equality_compares_type_and_value() {
        assert_eq!(Provenance::new(1u32), Provenance::new(1u32));
        assert_ne!(Provenance::new(1u32), Provenance::new(2u32));
        assert_ne!(Provenance::new(1u32), Provenance::new(1i32));
        assert_ne!(Provenance::new(1u32), Provenance::default());
        assert_eq!(Provenance::default(), Provenance::default());
    }

    #[test]
    fn a_clone_holds_the_same_data() {
        let provenance = Provenance::new(vec![1u8, 2]);
        let clone = provenance.clone();
        assert_eq!(clone.get::<Vec<u8>>(), Some(&vec![1, 2]));
        assert!(!clone.is_empty() && clone.get::<Vec<u16>>().is_none());
    }
}
