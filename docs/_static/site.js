// What Sphinx leaves out for keyboards and screen readers.
document.addEventListener("DOMContentLoaded", () => {
  for (const part of document.querySelectorAll("pre, .table-wrapper")) {
    const reach = () => {
      if (part.scrollWidth > part.clientWidth) part.tabIndex = 0;
      else part.removeAttribute("tabindex");
    };
    new ResizeObserver(reach).observe(part);
  }
  // Parameters of long signatures are a list without terms.
  for (const part of document.querySelectorAll("dt.sig dl, dt.sig dd")) part.setAttribute("role", "none");
});
