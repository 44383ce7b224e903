//! The panel beside the scene in the window: its readout and its controls.
//!
//! It knows names, values, bars and curves, but not what they mean.

use std::collections::VecDeque;

use egui_plot::{HLine, Line, Plot, PlotPoints};
use mujoco_rs::viewer::egui::containers::panel::PanelState;
use mujoco_rs::viewer::egui::{
    self, Align2, Color32, Event, FontId, Key, Rect, RichText, Sense, Slider, Ui, pos2, vec2,
};

/// The range of playback speeds, as multiples of real time.
pub const SPEEDS: std::ops::RangeInclusive<f64> = 0.05..=4.0;

/// A quantity shown as a bar.
pub struct Gauge {
    /// The name of the quantity.
    pub name: &'static str,
    /// The length of the bar: from 0 to 1, or from -1 if it has a sign, with zero in the middle.
    pub fraction: f32,
    /// Whether values below zero are possible.
    pub signed: bool,
    /// The value as text.
    pub text: String,
}

/// The recent history of a quantity.
#[derive(Clone, Default)]
pub struct Trend {
    /// The name and unit of the quantity.
    pub name: &'static str,
    /// Points of time (s) and value, oldest first.
    pub points: VecDeque<[f64; 2]>,
    /// A reference value, drawn as a line.
    pub level: Option<f64>,
}

/// The contents of the panel.
#[derive(Default)]
pub struct Readout {
    /// Rows of a name and a value.
    pub rows: Vec<(&'static str, String)>,
    /// Groups of bars, each under a heading.
    pub bars: Vec<(&'static str, Vec<Gauge>)>,
    /// Curves.
    pub curves: Vec<Trend>,
}

/// The user's input.
#[derive(Clone, Copy, Default)]
pub struct Controls {
    /// Whether time is stopped except for single steps.
    pub paused: bool,
    /// The playback speed, as a multiple of real time.
    pub speed: f64,
    /// The index of the choice that moves the hand.
    pub choice: usize,
    /// Single steps requested since the input was last read.
    pub steps: u32,
    /// Whether a new episode was requested.
    pub reset: bool,
    /// Whether a new goal was requested.
    pub new_goal: bool,
}

/// The state of the panel between two frames.
pub struct Panel {
    /// The names of the choices.
    pub choices: Vec<&'static str>,
    pub readout: Readout,
    pub controls: Controls,
}

impl Panel {
    /// Draws the panel at the right of the window and handles clicks and key presses.
    pub fn show(&mut self, ui: &mut Ui) {
        if !ui.egui_wants_keyboard_input() {
            self.take_keys(ui);
        }
        egui::Panel::right("shadow-repose")
            .resizable(true)
            .default_size(300.0)
            .show(ui, |ui| {
                egui::ScrollArea::vertical().show(ui, |ui| {
                    self.show_controls(ui);
                    self.show_readout(ui);
                });
            });
    }

    fn take_keys(&mut self, ui: &Ui) {
        let controls = &mut self.controls;
        ui.input(|input| {
            // On a slow machine, one frame may contain several presses.
            let odd = |key| input.num_presses(key) % 2 == 1;
            controls.paused ^= odd(Key::Space);
            controls.steps += input.num_presses(Key::ArrowRight) as u32;
            controls.reset |= input.key_pressed(Key::R);
            controls.new_goal |= input.key_pressed(Key::G);
            let doublings =
                input.num_presses(Key::ArrowUp) as i32 - input.num_presses(Key::ArrowDown) as i32;
            controls.speed =
                (controls.speed * 2f64.powi(doublings)).clamp(*SPEEDS.start(), *SPEEDS.end());
            controls.choice = (controls.choice + input.num_presses(Key::P)) % self.choices.len();
        });
        // A single step would not be visible while the scene runs.
        controls.paused |= controls.steps > 0;
    }

    fn show_controls(&mut self, ui: &mut Ui) {
        let controls = &mut self.controls;
        ui.add_space(4.0);
        ui.horizontal(|ui| {
            let pause = if controls.paused {
                "Resume (Space)"
            } else {
                "Pause (Space)"
            };
            controls.paused ^= ui.button(pause).clicked();
            if ui.button("Step (Right)").clicked() {
                controls.steps += 1;
                controls.paused = true;
            }
        });
        ui.horizontal(|ui| {
            controls.new_goal |= ui.button("New goal (G)").clicked();
            controls.reset |= ui.button("Reset (R)").clicked();
        });
        ui.horizontal(|ui| {
            ui.add(
                Slider::new(&mut controls.speed, SPEEDS)
                    .logarithmic(true)
                    .suffix(" ×"),
            );
            ui.label("speed (Up, Down)");
        });
        ui.horizontal(|ui| {
            for (i, name) in self.choices.iter().enumerate() {
                ui.radio_value(&mut controls.choice, i, *name);
            }
            ui.label("(P)");
        });
        egui::CollapsingHeader::new("Mouse and keys").default_open(true).show(ui, |ui| {
            ui.label("Drag: turn the view. Right-drag: move it. Scroll: zoom.");
            ui.label("Double-click the cube, then Ctrl + Alt + drag: pull it. Ctrl + drag: twist it.");
            ui.label("X: MuJoCo's own panel. Ctrl+Q: close.");
        });
        ui.separator();
    }

    fn show_readout(&self, ui: &mut Ui) {
        egui::Grid::new("rows").num_columns(2).show(ui, |ui| {
            for (name, value) in &self.readout.rows {
                ui.label(*name);
                ui.label(RichText::new(value).strong().monospace());
                ui.end_row();
            }
        });
        for (heading, bars) in &self.readout.bars {
            ui.separator();
            ui.label(*heading);
            for bar in bars {
                ui.horizontal(|ui| {
                    ui.add_sized([70.0, 16.0], egui::Label::new(bar.name));
                    draw_gauge(ui, bar);
                });
            }
        }
        for curve in &self.readout.curves {
            ui.separator();
            ui.label(curve.name);
            let seconds = |mark: egui_plot::GridMark, _: &_| format!("{} s", mark.value);
            let plot = Plot::new(curve.name)
                .height(100.0)
                .show_x(false)
                .include_y(0.0)
                .x_axis_formatter(seconds);
            plot.allow_drag(false)
                .allow_zoom(false)
                .allow_scroll(false)
                .show(ui, |plot| {
                    plot.line(Line::new(
                        curve.name,
                        PlotPoints::from_iter(curve.points.iter().copied()),
                    ));
                    if let Some(level) = curve.level {
                        plot.hline(HLine::new("level", level));
                    }
                });
        }
    }
}

/// Draws a bar with its value beside it. A signed bar grows from the middle: green to the right, orange to the left.
fn draw_gauge(ui: &mut Ui, gauge: &Gauge) {
    const POSITIVE: Color32 = Color32::from_rgb(60, 150, 90);
    const NEGATIVE: Color32 = Color32::from_rgb(205, 110, 40);
    let (rect, _) = ui.allocate_exact_size(vec2(ui.available_width(), 16.0), Sense::hover());
    let fraction = gauge.fraction.clamp(-1.0, 1.0);
    let zero = if gauge.signed {
        rect.center().x
    } else {
        rect.left()
    };
    let end = zero + fraction * (rect.right() - zero);
    let painter = ui.painter();
    painter.rect_filled(rect, 2.0, ui.visuals().extreme_bg_color);
    let bar = Rect::from_min_max(
        pos2(zero.min(end), rect.top()),
        pos2(zero.max(end), rect.bottom()),
    );
    painter.rect_filled(bar, 0.0, if fraction < 0.0 { NEGATIVE } else { POSITIVE });
    if gauge.signed {
        painter.vline(
            zero,
            rect.y_range(),
            ui.visuals().widgets.noninteractive.fg_stroke,
        );
    }
    painter.text(
        rect.right_center() - vec2(4.0, 0.0),
        Align2::RIGHT_CENTER,
        &gauge.text,
        FontId::monospace(12.0),
        ui.visuals().strong_text_color(),
    );
}

/// Closes MuJoCo's own panel at the left when the window opens. Its second reset and its physics options do not belong to the
/// task, and it takes a third of a small window. mujoco-rs has no setting for that, so this drags its edge to the window's
/// side, as a user could. The key X opens it again.
#[derive(Default)]
pub struct CloseLeftPanel {
    frame: usize,
}

impl egui::Plugin for CloseLeftPanel {
    fn debug_name(&self) -> &'static str {
        "close the left panel"
    }

    fn input_hook(&mut self, context: &egui::Context, input: &mut egui::RawInput) {
        // The panel is laid out in the first frames.
        let Some(panel) = PanelState::load(context, egui::Id::new("interface_panel")) else {
            return;
        };
        let edge = pos2(panel.outer_rect.right(), panel.outer_rect.center().y);
        let side = pos2(panel.outer_rect.left() - 50.0, edge.y);
        let press = |pos, pressed| Event::PointerButton {
            pos,
            button: egui::PointerButton::Primary,
            pressed,
            modifiers: egui::Modifiers::NONE,
        };
        let moved = Event::PointerMoved;
        let drag = [
            moved(edge),
            press(edge, true),
            moved(side),
            press(side, false),
            Event::PointerGone,
        ];
        if let Some(event) = drag.into_iter().nth(self.frame) {
            self.frame += 1;
            // No other event may come between.
            input.events = vec![event];
        }
    }
}
