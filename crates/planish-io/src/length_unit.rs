//! The length unit of a file's coordinates, if the file states it.

use planish_core::{ParamError, PointCloud};

/// A length unit. [`Display`](std::fmt::Display) prints its name.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct LengthUnit {
    /// The name, such as metre or US survey foot.
    pub name: &'static str,
    /// The symbol, such as m or ftUS.
    pub symbol: &'static str,
    /// Length of the unit in metres.
    pub metres: f64,
}

impl LengthUnit {
    /// The metre, which is assumed if a file states no unit.
    pub const METRE: Self = Self { name: "metre", symbol: "m", metres: 1.0 };
    /// The international foot.
    pub const FOOT: Self = Self { name: "foot", symbol: "ft", metres: 0.3048 };
    /// The US survey foot, used in older surveys in the USA.
    pub const US_SURVEY_FOOT: Self = Self { name: "US survey foot", symbol: "ftUS", metres: 1200.0 / 3937.0 };

    /// The millimetre.
    pub const MILLIMETRE: Self = Self { name: "millimetre", symbol: "mm", metres: 1e-3 };
    /// The centimetre.
    pub const CENTIMETRE: Self = Self { name: "centimetre", symbol: "cm", metres: 1e-2 };
    /// The inch.
    pub const INCH: Self = Self { name: "inch", symbol: "in", metres: 0.0254 };

    /// Returns the unit of a cloud's coordinates: the unit of the coordinate system if the cloud was read from a LAS
    /// or LAZ file that states one, otherwise the metre.
    pub fn of_cloud(cloud: &PointCloud) -> Self {
        Self::stated_by(cloud).unwrap_or(Self::METRE)
    }

    /// Returns the unit stated by the file that a cloud was read from.
    pub(crate) fn stated_by(cloud: &PointCloud) -> Option<Self> {
        #[cfg(feature = "scans")]
        return super::las::length_unit(cloud);
        #[cfg(not(feature = "scans"))]
        {
            let _ = cloud;
            None
        }
    }

    /// Returns true if the unit is the metre.
    pub fn is_metre(&self) -> bool {
        *self == Self::METRE
    }

    /// Returns the unit with an EPSG code; `None` for other codes.
    #[cfg(any(test, feature = "scans"))]
    pub(crate) fn of_epsg(code: u16) -> Option<Self> {
        match code {
            9001 => Some(Self::METRE),
            9002 => Some(Self::FOOT),
            9003 => Some(Self::US_SURVEY_FOOT),
            _ => None,
        }
    }

    /// Returns the known unit that has this length in metres.
    #[cfg(any(test, feature = "scans"))]
    pub(crate) fn of_metres(metres: f64) -> Option<Self> {
        // The international and the US survey foot differ by two parts in a million.
        let known = [Self::METRE, Self::FOOT, Self::US_SURVEY_FOOT];
        known.into_iter().find(|unit| (unit.metres - metres).abs() < 1e-8)
    }
}

impl std::str::FromStr for LengthUnit {
    type Err = ParamError;

    /// Parses the symbol of a unit: mm, cm, m, in (or inch) or ft.
    fn from_str(symbol: &str) -> Result<Self, ParamError> {
        match symbol {
            "mm" => Ok(Self::MILLIMETRE),
            "cm" => Ok(Self::CENTIMETRE),
            "m" => Ok(Self::METRE),
            "inch" | "in" => Ok(Self::INCH),
            "ft" => Ok(Self::FOOT),
            _ => Err(ParamError { field: "unit", value: format!("{symbol:?}"), allowed: "mm, cm, m, inch or ft" }),
        }
    }
}

impl std::fmt::Display for LengthUnit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name)
    }
}

/// Returns the linear unit of a coordinate system in well-known text, version 1 or 2.
#[cfg(any(test, feature = "scans"))]
pub(crate) fn unit_of_wkt(text: &str) -> Option<LengthUnit> {
    // Ellipsoids and parameters also have units, so the search starts at the axes. Angular units are skipped, and the
    // first linear unit is the horizontal one.
    let axes = [",CS[", "PROJECTION["].iter().find_map(|part| text.find(part));
    let text = &text[axes.unwrap_or(0)..];
    let units = text.match_indices("UNIT[").map(|(at, start)| &text[at + start.len()..]);
    units.into_iter().find_map(|unit| {
        // The number follows the quoted name.
        let (_, rest) = unit.split_once('"')?.1.split_once('"')?;
        let number = rest.trim_start_matches(',').split([',', ']']).next()?;
        LengthUnit::of_metres(number.trim().parse().ok()?)
    })
}

/// Returns the unit of heights of a compound coordinate system in well-known text, version 1 or 2.
#[cfg(any(test, feature = "scans"))]
pub(crate) fn height_unit_of_wkt(text: &str) -> Option<LengthUnit> {
    let vertical = ["VERT_CS[", "VERTCRS[", "VERTICALCRS["].iter().find_map(|part| text.find(part))?;
    unit_of_wkt(&text[vertical..])
}

/// GeoTIFF's ProjLinearUnitsGeoKey.
#[cfg(any(test, feature = "scans"))]
pub(crate) const LINEAR_UNIT: u16 = 3076;
/// GeoTIFF's VerticalUnitsGeoKey.
#[cfg(any(test, feature = "scans"))]
pub(crate) const HEIGHT_UNIT: u16 = 4099;

/// Returns the unit that a GeoTIFF key states. The keys are records of four numbers after a header of four numbers.
#[cfg(any(test, feature = "scans"))]
pub(crate) fn unit_of_geo_keys(bytes: &[u8], key: u16) -> Option<LengthUnit> {
    let numbers: Vec<u16> = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
    let value = |key: u16| {
        let keys = numbers.get(4..)?.chunks_exact(4);
        // A location (second number) of 0 means that the last number is the value itself.
        keys.into_iter().find(|entry| entry[0] == key && entry[1] == 0).map(|entry| entry[3])
    };
    LengthUnit::of_epsg(value(key)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_read_from_well_known_text_and_from_geo_keys() {
        let wkt1 = r#"PROJCS["NAD83",GEOGCS["NAD83",DATUM["D",SPHEROID["GRS 1980",6378137,298.257]],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]]],PROJECTION["P"],UNIT["foot",0.3048,AUTHORITY["EPSG","9002"]]]"#;
        assert_eq!(unit_of_wkt(wkt1), Some(LengthUnit::FOOT));
        let survey = r#"PROJCS["x",UNIT["US survey foot",0.3048006096012192,AUTHORITY["EPSG","9003"]]]"#;
        assert_eq!(unit_of_wkt(survey), Some(LengthUnit::US_SURVEY_FOOT));
        let wkt2 = r#"PROJCRS["x",BASEGEOGCRS["y",ANGLEUNIT["degree",0.0174]],CS[Cartesian,2],LENGTHUNIT["metre",1,ID["EPSG",9001]]]"#;
        assert_eq!(unit_of_wkt(wkt2), Some(LengthUnit::METRE));
        let of_axes = r#"PROJCRS["x",BASEGEOGCRS["y",DATUM["d",ELLIPSOID["GRS 1980",6378137,298.257,LENGTHUNIT["metre",1]]]],CONVERSION["c",METHOD["m"]],CS[Cartesian,2],AXIS["easting (X)",east,ORDER[1],LENGTHUNIT["US survey foot",0.304800609601219]]]"#;
        assert_eq!(unit_of_wkt(of_axes), Some(LengthUnit::US_SURVEY_FOOT));
        for nothing in ["", "PROJCS[", "UNIT[", r#"UNIT["fathom",1.8288]"#, "UNIT[]", r#"UNIT["x"#] {
            assert_eq!(unit_of_wkt(nothing), None, "{nothing}");
        }
        let keys = |entries: &[[u16; 4]]| -> Vec<u8> {
            let header = [[1, 1, 0, entries.len() as u16]];
            header.iter().chain(entries).flatten().flat_map(|number| number.to_le_bytes()).collect()
        };
        assert_eq!(
            unit_of_geo_keys(&keys(&[[1024, 0, 1, 1], [3076, 0, 1, 9003]]), LINEAR_UNIT),
            Some(LengthUnit::US_SURVEY_FOOT)
        );
        assert_eq!(unit_of_geo_keys(&keys(&[[3076, 0, 1, 9002]]), LINEAR_UNIT), Some(LengthUnit::FOOT));
        // Key 4099 states the unit of heights, not of x and y.
        assert_eq!(unit_of_geo_keys(&keys(&[[4099, 0, 1, 9002]]), LINEAR_UNIT), None);
        assert_eq!(unit_of_geo_keys(&keys(&[[4099, 0, 1, 9002]]), HEIGHT_UNIT), Some(LengthUnit::FOOT));
        let compound = r#"COMPD_CS["a",PROJCS["b",PROJECTION["P"],UNIT["metre",1]],VERT_CS["NAVD88",VERT_DATUM["d",2005],UNIT["foot",0.3048]]]"#;
        assert_eq!(unit_of_wkt(compound), Some(LengthUnit::METRE));
        assert_eq!(height_unit_of_wkt(compound), Some(LengthUnit::FOOT));
        assert_eq!(height_unit_of_wkt(wkt1), None);
        let compound2 = r#"COMPOUNDCRS["a",PROJCRS["b",CS[Cartesian,2],LENGTHUNIT["metre",1]],VERTCRS["c",VDATUM["d"],CS[vertical,1],AXIS["up",up],LENGTHUNIT["US survey foot",0.304800609601219]]]"#;
        assert_eq!(height_unit_of_wkt(compound2), Some(LengthUnit::US_SURVEY_FOOT));
        for nothing in [keys(&[]), keys(&[[3076, 34736, 1, 0]]), keys(&[[3076, 0, 1, 9005]]), vec![1, 0, 3], Vec::new()]
        {
            assert_eq!(unit_of_geo_keys(&nothing, LINEAR_UNIT), None);
        }
    }
}
