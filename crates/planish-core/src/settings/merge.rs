//! Merging of settings: for example, command-line options override the settings in a file.

use super::{Settings, TemporalChoice};
use crate::engines::Engine;
use crate::threads::ONE_THREAD;

impl Settings {
    /// Overrides these settings with everything that `over` sets, and drops settings that contradict `over`. Strength
    /// contradicts preset, neighbours contradict a radius, and devices contradict an engine or adapter. An engine
    /// other than the GPU drops the adapter, and `temporal=off` drops `track`.
    ///
    /// ```
    /// let mut settings: planish::Settings = "strength=0.3 engine=gpu adapter=0".parse()?;
    /// settings.override_with("preset=light engine=cpu".parse()?);
    /// assert_eq!(settings, "preset=light engine=cpu".parse()?);
    /// # Ok::<(), planish::ParamError>(())
    /// ```
    pub fn override_with(&mut self, over: Self) {
        self.strength = self.strength.filter(|_| over.preset.is_none());
        self.preset = self.preset.filter(|_| over.strength.is_none());
        self.neighbours = self.neighbours.filter(|_| over.radius.is_none());
        self.radius = self.radius.filter(|_| over.neighbours.is_none());
        if over.devices.is_some() {
            (self.engine, self.adapter) = (None, None);
        }
        if over.temporal == Some(TemporalChoice::Off) {
            self.track = None;
        }
        if over.engine.is_some() || over.adapter.is_some() {
            self.devices = None;
        }
        if over.engine.is_some_and(|engine| engine != Engine::Gpu) {
            self.adapter = None;
        }
        // Every field is named, so the compiler reports a field that is missing here.
        let Self {
            preset,
            strength,
            sensor,
            edges,
            remove_floating,
            min_range_m,
            max_range_m,
            decimate,
            fill,
            remove_isolated,
            window,
            stride,
            average_blocks,
            radius,
            neighbours,
            passes,
            grid,
            even,
            temporal,
            track,
            degree,
            bandwidth_m,
            ridge,
            project,
            engine,
            adapter,
            devices,
            threads,
            outputs,
        } = over;
        self.preset = preset.or(self.preset);
        self.strength = strength.or(self.strength);
        self.sensor = sensor.or(self.sensor);
        self.edges = edges.or(self.edges);
        self.remove_floating = remove_floating.or(self.remove_floating);
        if !ONE_THREAD {
            self.min_range_m = min_range_m.or(self.min_range_m);
            self.max_range_m = max_range_m.or(self.max_range_m);
            self.decimate = decimate.or(self.decimate);
            self.fill = fill.or(self.fill);
        }
        self.remove_isolated = remove_isolated.or(self.remove_isolated);
        self.window = window.or(self.window);
        self.stride = stride.or(self.stride);
        self.average_blocks = average_blocks.or(self.average_blocks);
        self.radius = radius.or(self.radius);
        self.neighbours = neighbours.or(self.neighbours);
        self.passes = passes.or(self.passes);
        self.grid = grid.or(self.grid);
        self.even = even.or(self.even);
        self.temporal = temporal.or(self.temporal);
        self.track = track.or(self.track);
        self.degree = degree.or(self.degree);
        self.bandwidth_m = bandwidth_m.or(self.bandwidth_m);
        self.ridge = ridge.or(self.ridge);
        self.project = project.or(self.project);
        self.engine = engine.or(self.engine);
        self.adapter = adapter.or_else(|| self.adapter.take());
        self.devices = devices.or_else(|| self.devices.take());
        self.threads = threads.or(self.threads);
        self.outputs = outputs.or(self.outputs);
    }
}
