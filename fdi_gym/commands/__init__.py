"""The commands of `fdi-gym`, by what they are about; `fdi_gym.cli` names them. Each imports what it needs when it runs."""
