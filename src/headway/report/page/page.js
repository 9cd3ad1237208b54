for (const button of document.querySelectorAll("button[data-copies]")) {
  button.addEventListener("click", () => {
    const text = document.getElementById(button.dataset.copies);
    text.select();
    // A page opened from a file may not use navigator.clipboard everywhere.
    const copied = document.execCommand("copy");
    button.parentElement.querySelector("[role=status]").textContent = copied
      ? "Copied."
      : "Selected: press Ctrl+C or ⌘C.";
  });
}
