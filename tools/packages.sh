# Sourced by the set-up scripts: runs what needs root when it may, else says what to type.

# Prints how to run a command as root without a prompt: nothing as root, "sudo -n" if that works; fails if neither.
root_prefix() {
    if [ "$(id -u)" = 0 ]; then
        return
    fi
    sudo -n true 2>/dev/null && echo "sudo -n"
}

# as_root WHAT COMMAND...: install WHAT with COMMAND as root, or print the command and fail.
as_root() {
    local what=$1 prefix
    shift
    if prefix=$(root_prefix) && command -v apt-get >/dev/null; then
        echo "setup: installing $what"
        $prefix env DEBIAN_FRONTEND=noninteractive "$@"
        return
    fi
    printf 'setup: missing: %s. Run this, then repeat the command:\n\n    sudo%s\n\n' "$what" "$(printf ' %q' "$@")" >&2
    return 1
}
