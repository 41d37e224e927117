fn main() -> std::process::ExitCode {
    echotank::cli::main()
}
