//! The command line as texts for other programs: shell completions and a manual page.

use anyhow::Result;
use clap_complete::Shell;

use crate::cli::command;
use crate::os;

const PROGRAM: &str = "shadow-repose";

/// The beginning of a line for fish that completes words after a command, whose name follows.
const FISH: &str = "complete -c shadow-repose -f -n \"__fish_shadow_repose_using_subcommand";

/// Prints completions for a shell.
///
/// # Errors
/// Fails if stdout cannot be written to.
pub fn completions(shell: Shell) -> Result<()> {
    // For a name with a hyphen, clap_complete 4.6 gives each command two names in a script for bash, and completes nothing after a
    // command.
    let is_bash = shell == Shell::Bash;
    let name = if is_bash { "shadow_repose" } else { PROGRAM };
    let mut program = command().name(name);
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut program, name, &mut text);
    let text = String::from_utf8(text)?;
    let commands = program.get_subcommands().map(clap::Command::get_name);
    let commands = Vec::from_iter(commands).join(" ");
    os::print(&match shell {
        Shell::Bash => text.replace(" shadow_repose\n", " shadow-repose\n"),
        // clap_complete 4.6 leaves out the values of arguments without an option, and the commands after `help`.
        Shell::Fish => format!(
            "{text}{FISH} completions\" -a \"bash elvish fish powershell zsh\"\n{FISH} help\" -a \"{commands}\"\n"
        ),
        _ => text,
    })
}

/// Prints a manual page of all commands.
///
/// # Errors
/// Fails if stdout cannot be written to.
pub fn man() -> Result<()> {
    let mut program = command().name(PROGRAM);
    program.build();
    let mut page = Vec::new();
    let whole = clap_mangen::Man::new(program.clone());
    whole.render_title(&mut page)?;
    whole.render_name_section(&mut page)?;
    whole.render_synopsis_section(&mut page)?;
    whole.render_description_section(&mut page)?;
    let mut page = String::from_utf8(page)?;
    for command in program
        .get_subcommands()
        .filter(|command| command.get_name() != "help")
    {
        let mut section = Vec::new();
        let part = clap_mangen::Man::new(command.clone());
        part.render_description_section(&mut section)?;
        part.render_options_section(&mut section)?;
        part.render_extra_section(&mut section)?;
        // Sections of the command's own page are parts of one section here.
        let section = String::from_utf8(section)?.replace(".SH ", ".SS ");
        page += &format!(
            ".SH \"SHADOW-REPOSE {}\"\n{section}",
            command.get_name().to_uppercase()
        );
    }
    os::print(&page)
}
